# SPDX-License-Identifier: GPL-3.0-or-later
"""Ctrl-C, and other requests to stop, while a verb runs.

Blender prints an exception that leaves a handler, a property's update function or what it calls to register a class,
and goes on; numpy turns one that strikes while it is imported into an ImportError. So a request that comes there is
repeated until the verb is elsewhere.
"""

import threading
from _thread import interrupt_main
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from types import FrameType

from ..core.stop_signals import handle_stop_signals, restore_handlers

RETRY_SECONDS = 0.01
_ADDON = __name__.rsplit(".", 2)[0]
_MAIN = f"{_ADDON}.cli.main"
_REGISTRATION_UPDATES_AND_DRAWING = {
    f"{_ADDON}.{name}" for name in ("registration", "properties.binding", "evaluation.overlay")
}

_called_by_blender: set[str] = set(_REGISTRATION_UPDATES_AND_DRAWING)
"""Modules whose functions Blender calls."""
_pending = 0
"""Signal of a request that had to wait."""


@contextmanager
def interruptible() -> Iterator[None]:
    """Inside, a request to stop raises KeyboardInterrupt(signal), at once or as soon as it does not get lost."""
    if threading.current_thread() is not threading.main_thread():
        # Only the main thread may say what a signal does; it is not this job that Ctrl-C ends.
        yield
        return
    global _pending
    _pending = 0
    previous = handle_stop_signals(_on_request)
    try:
        yield
    finally:
        restore_handlers(previous)


def note_callbacks(modules: Iterable[str]) -> None:
    """Let no KeyboardInterrupt be raised in functions of these modules, which Blender calls."""
    global _called_by_blender
    _called_by_blender = {*modules} | _REGISTRATION_UPDATES_AND_DRAWING


def raise_pending() -> None:
    """Raise the KeyboardInterrupt of a request that had to wait, if there is one; for the end of imports."""
    global _pending
    if _pending:
        number, _pending = _pending, 0
        raise KeyboardInterrupt(number)


def _repeat() -> None:
    if _pending:
        interrupt_main(_pending)


def _on_request(number: int, frame: FrameType | None) -> None:
    global _pending
    _pending = number
    while frame is not None and frame.f_globals.get("__name__") != _MAIN:
        is_import = frame.f_code.co_filename.startswith("<frozen importlib")
        if is_import or frame.f_globals.get("__name__") in _called_by_blender:
            timer = threading.Timer(RETRY_SECONDS, _repeat)
            timer.daemon = True
            timer.start()
            return
        frame = frame.f_back
    raise_pending()
