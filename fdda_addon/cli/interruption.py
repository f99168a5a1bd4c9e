# SPDX-License-Identifier: GPL-3.0-or-later
"""Handling of Ctrl-C and other stop signals while a verb runs.

Blender catches and prints exceptions in handlers, in update functions of properties and while it registers classes.
numpy converts an exception during its import to an ImportError. So a signal that arrives there is repeated until the
verb has left that code.
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
"""Names of modules whose functions Blender calls."""
_pending = 0
"""Number of a signal that is delayed, 0 for none."""


@contextmanager
def interruptible() -> Iterator[None]:
    """Raise KeyboardInterrupt(signal) for stop signals in the block, as soon as Blender cannot catch it."""
    if threading.current_thread() is not threading.main_thread():
        # Only the main thread can install signal handlers.
        yield
        return
    global _pending
    _pending = 0
    previous = handle_stop_signals(_on_request)
    try:
        yield
    finally:
        restore_handlers(previous)


def set_callback_modules(modules: Iterable[str]) -> None:
    """Set the modules whose functions Blender calls, in which no KeyboardInterrupt is raised."""
    global _called_by_blender
    _called_by_blender = {*modules} | _REGISTRATION_UPDATES_AND_DRAWING


def raise_pending() -> None:
    """Raise the KeyboardInterrupt of a delayed signal, if there is one, after imports."""
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
