# SPDX-License-Identifier: GPL-3.0-or-later
"""Handles Ctrl-C and other stop signals while a verb runs.

Blender catches and prints exceptions in handlers, in update functions of properties and while it registers classes.
numpy converts an exception during its import to an ImportError. A signal that arrives in
such code is therefore repeated until this code has returned.
"""

import threading
from _thread import interrupt_main
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from ..core.files.stop_signals import handle_stop_signals, restore_handlers

RETRY_SECONDS = 0.01
_ADDON_PACKAGE = __name__.rsplit(".", 2)[0]
_MAIN_MODULE = f"{_ADDON_PACKAGE}.cli.main"
_CALLBACK_MODULES = {f"{_ADDON_PACKAGE}.{name}" for name in ("registration", "properties.binding")}

_pending_signal = 0
"""Number of the delayed signal; 0 without one."""


@contextmanager
def interruptible() -> Iterator[None]:
    """Raise KeyboardInterrupt(signal) for stop signals in the block, as soon as the exception cannot get lost."""
    if threading.current_thread() is not threading.main_thread():
        # Only the main thread can install signal handlers.
        yield
        return
    global _pending_signal
    _pending_signal = 0
    previous_handlers = handle_stop_signals(_on_signal)
    try:
        yield
    finally:
        restore_handlers(previous_handlers)


def raise_pending() -> None:
    """Raise the KeyboardInterrupt of a delayed signal, if there is one. Called after imports."""
    global _pending_signal
    if _pending_signal:
        signal_number, _pending_signal = _pending_signal, 0
        raise KeyboardInterrupt(signal_number)


def _repeat_signal() -> None:
    if _pending_signal:
        interrupt_main(_pending_signal)


def _has_callbacks(module_globals: dict[str, object]) -> bool:
    """Return whether Blender calls functions of a module; those with handlers list them in `HANDLERS`."""
    name = str(module_globals.get("__name__"))
    return name in _CALLBACK_MODULES or (name.startswith(_ADDON_PACKAGE) and "HANDLERS" in module_globals)


def _on_signal(signal_number: int, frame: FrameType | None) -> None:
    global _pending_signal
    _pending_signal = signal_number
    while frame is not None and frame.f_globals.get("__name__") != _MAIN_MODULE:
        is_import = frame.f_code.co_filename.startswith("<frozen importlib")
        if is_import or _has_callbacks(frame.f_globals):
            timer = threading.Timer(RETRY_SECONDS, _repeat_signal)
            timer.daemon = True
            timer.start()
            return
        frame = frame.f_back
    raise_pending()
