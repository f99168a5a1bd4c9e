# SPDX-License-Identifier: GPL-3.0-or-later
"""Keeps Python's thread state for the threads on which Blender evaluates.

Blender calls a getter on whichever thread evaluates. Python creates a state for a thread that it does not know and
destroys it after the call, which maps and unmaps memory and interrupts the other processors. On two cores that takes
0.1 ms of a frame. A second `PyGILState_Ensure` without a release keeps the state (Python/C API, Initialization,
Finalization, and Threads).
"""

import ctypes
import os
import threading

MAX_KEPT_STATES = 2 * (os.cpu_count() or 1)
"""Blender evaluates with one thread for each processor. Renders use threads of their own, whose states stay when the
threads end."""

_threads_with_state = {threading.main_thread().ident}


def keep_thread_state() -> None:
    """Keep the state of the calling thread, once. Call it where other than Python code has called Python."""
    thread = threading.get_ident()
    if thread not in _threads_with_state and len(_threads_with_state) < MAX_KEPT_STATES:
        _threads_with_state.add(thread)
        ctypes.pythonapi.PyGILState_Ensure()
