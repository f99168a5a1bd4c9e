# SPDX-License-Identifier: GPL-3.0-or-later
"""Ctrl-C while a verb runs.

Blender prints an exception that leaves a handler or a property's update function, and goes on. A Ctrl-C that strikes
there would be lost, so it is kept until the verb is back in code of its own.
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_ADDON = __name__.rsplit(".", 2)[0]
_UPDATES_AND_DRAWING = {f"{_ADDON}.properties.binding", f"{_ADDON}.evaluation.overlay"}

_called_by_blender: set[str] = set()
"""Modules whose functions Blender calls."""
_pending = False


@contextmanager
def interruptible() -> Iterator[None]:
    """Inside, Ctrl-C raises KeyboardInterrupt, at once or from the next `raise_pending`."""
    global _pending, _called_by_blender
    # Not above: verbs that need no Blender show progress too.
    from ..registration import handler_table

    _pending = False
    _called_by_blender = {handler.__module__ for _, handler in handler_table()} | _UPDATES_AND_DRAWING
    if threading.current_thread() is not threading.main_thread():
        # Only the main thread may say what a signal does; it is not this job that Ctrl-C ends.
        yield
        return
    previous = signal.signal(signal.SIGINT, _on_interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous or signal.default_int_handler)


def raise_pending() -> None:
    """Raise the KeyboardInterrupt that had to wait, if there is one."""
    global _pending
    if _pending:
        _pending = False
        raise KeyboardInterrupt


def _on_interrupt(_number: int, frame: FrameType | None) -> None:
    global _pending
    while frame is not None:
        if frame.f_globals.get("__name__") in _called_by_blender:
            _pending = True
            return
        frame = frame.f_back
    raise KeyboardInterrupt
