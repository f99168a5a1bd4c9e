# SPDX-License-Identifier: GPL-3.0-or-later
"""Lets Python know the threads that evaluate.

Blender calls a getter on whichever thread evaluates. Python makes a state for a thread that it does not know, and does
away with it after the call: memory is mapped and unmapped for it, of which the other processors are told each time. On
two cores that is 0.1 ms of a frame. A second `PyGILState_Ensure`, which is not followed by its release, leaves the
state in place (Python/C API, Initialization, Finalization, and Threads).
"""

import ctypes
import os
import threading

MOST_KEPT = 2 * (os.cpu_count() or 1)
"""Blender evaluates with a thread for each processor. Renders come on threads of their own: those end, their states
stay."""

_kept = {threading.main_thread().ident}


def keep_thread() -> None:
    """Keep the state of the thread that calls, once; to be called where Python was called by another language."""
    thread = threading.get_ident()
    if thread not in _kept and len(_kept) < MOST_KEPT:
        _kept.add(thread)
        ctypes.pythonapi.PyGILState_Ensure()
