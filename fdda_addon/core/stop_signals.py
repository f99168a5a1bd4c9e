# SPDX-License-Identifier: GPL-3.0-or-later
"""Signals that ask a process to stop. Imports little, because it is used before all other imports."""

import os
import signal
from collections.abc import Callable

INTERRUPTED = 130
"""Exit status of a process that a signal stopped."""
STOP_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK") if hasattr(signal, name)]
"""Ctrl-C, a request to end, a terminal that closes; SIGBREAK is Windows' for Ctrl-Break and a console that closes."""


def handle_stop_signals(handler: Callable) -> dict[int, object]:
    """Install a handler for all stop signals but those that the process inherited as ignored; Ctrl-C is always handled.

    Returns:
        The previous handlers by signal, for `restore_handlers`; None for a handler that was not installed from Python.
    """
    return {
        number: signal.signal(number, handler)
        for number in STOP_SIGNALS
        if number == signal.SIGINT or signal.getsignal(number) is not signal.SIG_IGN
    }


def restore_handlers(handlers: dict[int, object]) -> None:
    """Undo `handle_stop_signals`."""
    for number, handler in handlers.items():
        default = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
        signal.signal(number, default if handler is None else handler)


def exit_on_stop_signal() -> None:
    """Let stop signals end the process at once, without a traceback, before it has data to lose."""
    handle_stop_signals(lambda *_: os._exit(INTERRUPTED))
