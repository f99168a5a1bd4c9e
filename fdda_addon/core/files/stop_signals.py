# SPDX-License-Identifier: GPL-3.0-or-later
"""Signals that ask a process to stop. This module imports little, because programs import it before all others."""

import os
import signal
from collections.abc import Callable

INTERRUPTED = 130
"""Exit status of a process that a signal stopped."""
STOP_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK") if hasattr(signal, name)]
"""SIGINT is Ctrl-C, SIGTERM asks a process to end, SIGHUP means that its terminal was closed. SIGBREAK exists on
Windows, for Ctrl-Break and a console that was closed."""


def handle_stop_signals(handler: Callable) -> dict[int, object]:
    """Install a handler for all stop signals.

    Signals that the process inherited as ignored stay ignored, except for Ctrl-C.

    Returns:
        The previous handlers by signal, for `restore_handlers`; None for a handler that was not installed from Python.
    """
    return {
        signal_number: signal.signal(signal_number, handler)
        for signal_number in STOP_SIGNALS
        if signal_number == signal.SIGINT or signal.getsignal(signal_number) is not signal.SIG_IGN
    }


def restore_handlers(handlers: dict[int, object]) -> None:
    """Undo `handle_stop_signals`."""
    for signal_number, handler in handlers.items():
        default_handler = signal.default_int_handler if signal_number == signal.SIGINT else signal.SIG_DFL
        signal.signal(signal_number, default_handler if handler is None else handler)


def exit_on_stop_signal() -> None:
    """Let stop signals end the process at once, without a traceback, before it has data to lose."""
    handle_stop_signals(lambda *_: os._exit(INTERRUPTED))
