# SPDX-License-Identifier: GPL-3.0-or-later
"""The errors that users read.

Each carries one sentence: what is wrong, with names and numbers, and what to do about it. The command line prints
it and exits with status 1, or with `TRY_AGAIN` where the machine is to blame; an operator reports it and is cancelled.
Any other exception is a bug and propagates.
"""

import errno
import os
import re

TRY_AGAIN = 75
"""Exit status of what may work when it is run again, as it is or on another machine: EX_TEMPFAIL of sysexits.h."""
MACHINE_ERRNOS = {
    getattr(errno, name)
    for name in (
        *("ENOSPC", "EDQUOT", "EIO", "ENOMEM", "EAGAIN", "EBUSY", "EINTR", "EMFILE", "ENFILE", "ENXIO", "ENODEV"),
        *("ESTALE", "ENOLCK", "ENOTCONN", "ETIMEDOUT", "EHOSTDOWN", "EHOSTUNREACH", "ENETDOWN", "ENETUNREACH"),
        *("ECONNREFUSED", "ECONNRESET", "EREMOTEIO"),
    )
    if hasattr(errno, name)
}
"""What the system says when a disk, the memory or a shared folder gave out, and not when a path is wrong."""
MACHINE_WINERRORS = {8, 14, 21, 32, 33, 39, 53, 59, 64, 112, 121, 1117, 1224, 1231, 1450, 1455}
"""The same as Windows numbers it, and that another program has a file open; Python knows few of these by `errno`."""
_WINERROR_TEXTS = {
    **dict.fromkeys((32, 33, 1224), "another program has it open"),
    **dict.fromkeys((39, 112), os.strerror(errno.ENOSPC)),
    **dict.fromkeys((8, 14, 1450, 1455), os.strerror(errno.ENOMEM)),
    206: os.strerror(errno.ENAMETOOLONG),
}
MAX_SENTENCE_LENGTH = 1000
"""Letters of a sentence. What a file of somebody else's says is quoted in it, and may be a million letters long."""
_CONTROL_CHARACTERS = r"[\x00-\x1f\x7f-\x9f\u2028\u2029]"


def to_single_line(text: str) -> str:
    """A text of a readable length that a terminal shows as one line: what would steer it is written out."""
    if len(text) > MAX_SENTENCE_LENGTH:
        half = MAX_SENTENCE_LENGTH // 2
        text = f"{text[:half]} […] {text[-half:]}"
    return re.sub(_CONTROL_CHARACTERS, lambda found: repr(found.group())[1:-1], text)


def os_error_text(error: OSError) -> str:
    """What the system says of an error, in English; Windows says it in its own language."""
    number = getattr(error, "winerror", None)
    if not number:
        return error.strerror or str(error)
    # What Python has no number of its own for is EINVAL.
    words = f"error {number} of Windows" if error.errno == errno.EINVAL else os.strerror(error.errno)
    return _WINERROR_TEXTS.get(number, words)


class FDDAError(Exception):
    """Base of every error whose text is meant for the user; `exit_status` is that of the command line."""

    exit_status = 1

    def __str__(self) -> str:
        return to_single_line(super().__str__())


def exit_status(error: BaseException) -> int:
    """Exit status of the command line for an error: `TRY_AGAIN` where the machine caused it."""
    status = getattr(error, "exit_status", FDDAError.exit_status)
    if status != FDDAError.exit_status:
        return status
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, MemoryError) or (isinstance(cause, OSError) and _is_machine_fault(cause)):
            return TRY_AGAIN
        cause = cause.__cause__
    return status


def machine_fault_sentence(error: BaseException) -> str:
    """What to say of an error that nobody foresaw where the machine caused it; empty where it may be a bug."""
    if isinstance(error, MemoryError):
        return "The memory of this machine is used up; free some, or use a larger one."
    if isinstance(error, OSError) and _is_machine_fault(error):
        name = f"'{error.filename}': " if error.filename else ""
        return f"{name}{os_error_text(error)}; make room, end other programs, or try again."
    return ""


def _is_machine_fault(error: OSError) -> bool:
    return error.errno in MACHINE_ERRNOS or getattr(error, "winerror", None) in MACHINE_WINERRORS


class WrongUsageError(FDDAError):
    """Options that make no sense. The text may be that of the parser, several lines."""

    exit_status = 2
    __str__ = Exception.__str__


class RigError(FDDAError):
    """The scene holds no rig that can be recorded, bound or evaluated."""


class RecordingError(FDDAError):
    """A recording cannot be read, resumed or written."""


class BusyError(RecordingError):
    """Another process is at it."""

    exit_status = TRY_AGAIN


class ModelError(FDDAError):
    """A model cannot be read, or was trained for another rig."""


class TrainingError(FDDAError):
    """The training could not start, died, or reported a failure."""


class TrainingDiedError(TrainingError):
    """The training was ended from outside, or lacked memory or disk."""

    exit_status = TRY_AGAIN


class TrainerEnvironmentError(FDDAError):
    """The Python environment of the trainer cannot be made, removed or used."""


class OutputError(FDDAError):
    """An output path cannot be written."""


class DiskFullError(OutputError):
    """The disk lacks the room."""

    exit_status = TRY_AGAIN


class PointCacheError(FDDAError):
    """A point cache cannot be read."""
