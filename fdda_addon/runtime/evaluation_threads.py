# SPDX-License-Identifier: GPL-3.0-or-later
"""Keeps Python's thread state for the threads on which Blender evaluates.

Blender calls a getter on the thread that evaluates. If Python does not know the thread, it creates a state for it and
destroys the state after the call. Each time this maps and unmaps memory and interrupts the other processors. A second
`PyGILState_Ensure` without a release keeps the state (Python/C API, Initialization, Finalization, and Threads).
"""

import ctypes
import os
import threading

MAX_KEPT_STATES = 2 * (os.cpu_count() or 1)
"""Largest number of threads whose states are kept. Blender evaluates with one thread per processor. The states of
threads that end, such as those of renders, stay in memory."""

_thread_ids_with_state = {threading.main_thread().ident}


def keep_thread_state() -> None:
    """Keep the state of the calling thread, once. Call it in functions that Blender calls."""
    thread_id = threading.get_ident()
    if thread_id not in _thread_ids_with_state and len(_thread_ids_with_state) < MAX_KEPT_STATES:
        _thread_ids_with_state.add(thread_id)
        ctypes.pythonapi.PyGILState_Ensure()
