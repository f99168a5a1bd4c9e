# SPDX-License-Identifier: GPL-3.0-or-later
"""Explains the exit status of a process on Linux, macOS or Windows."""

import os
from typing import NamedTuple

from ..core.errors import TRY_AGAIN
from ..core.files.native_library import runtime_url

_WINDOWS_CRASHES = {0x80000003, 0xE06D7363}
"""Exit statuses after a breakpoint and an exception of C++; those of other crashes begin with 0xC."""
_MISSING_DLL_STATUSES = {0xC0000135, 0xC0000139, 0xC0000142}
_CONSOLE_CLOSED_STATUS = 0xC000013A
_TERMINATED_STATUSES = {1, 15}
"""Exit statuses of a process that the Task Manager or `os.kill` terminates on Windows."""


class ProcessExit(NamedTuple):
    """How a process ended.

    Attributes:
        text: predicate of a sentence that begins with "The trainer".
        is_machine_fault: whether it crashed or was terminated, so that the same command may work later.
    """

    text: str
    is_machine_fault: bool


def explain_exit_status(status: int | None, is_silent: bool) -> ProcessExit:
    """Explain the exit status of a process that ended without a last message.

    Args:
        status: exit status, signed or unsigned; None if it is unknown.
        is_silent: whether the process wrote nothing to stderr; a Python that fails writes its exception.
    """
    if status is None:
        return ProcessExit("was ended before it was done" if is_silent else "ended before it was done", is_silent)
    code = status & 0xFFFFFFFF
    if code in _MISSING_DLL_STATUSES:
        return ProcessExit(f"cannot start: a DLL is missing (0x{code:08X}); install {runtime_url()}", False)
    if code == _CONSOLE_CLOSED_STATUS:
        return ProcessExit("was ended with its console before it was done", True)
    if code in _WINDOWS_CRASHES or 0xC0000000 <= code < 0xD0000000:
        return ProcessExit(f"crashed: status 0x{code:08X}", True)
    if status < 0:
        return ProcessExit(f"was ended by signal {-status} before it was done", True)
    was_terminated = os.name == "nt" and is_silent and status in _TERMINATED_STATUSES
    description = "was ended from outside" if was_terminated else f"ended with status {status}"
    return ProcessExit(f"{description} before it was done", was_terminated or status == TRY_AGAIN)
