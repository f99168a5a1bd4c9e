# SPDX-License-Identifier: GPL-3.0-or-later
"""Errors with a message for the user.

Each message is one sentence: what is wrong, with names and numbers, and what to do. The command line prints it and
exits with status 1, or with `TRY_AGAIN` where the machine caused the error; an operator reports it and is canceled.
Any other exception is a bug and propagates.
"""

import errno
import os
import re

TRY_AGAIN = 75
"""Exit status of a command that may succeed later or on another machine: EX_TEMPFAIL of sysexits.h."""
MACHINE_ERRNOS = {
    getattr(errno, name)
    for name in (
        *("ENOSPC", "EDQUOT", "EIO", "ENOMEM", "EAGAIN", "EBUSY", "EINTR", "EMFILE", "ENFILE", "ENXIO", "ENODEV"),
        *("ESTALE", "ENOLCK", "ENOTCONN", "ETIMEDOUT", "EHOSTDOWN", "EHOSTUNREACH", "ENETDOWN", "ENETUNREACH"),
        *("ECONNREFUSED", "ECONNRESET", "EREMOTEIO"),
    )
    if hasattr(errno, name)
}
"""Values of errno for failures of a disk, the memory or a shared folder, as opposed to a wrong path."""
MACHINE_WINERRORS = {8, 14, 21, 32, 33, 39, 53, 59, 64, 112, 121, 1117, 1224, 1231, 1450, 1455}
"""Windows error numbers for the same failures, and for a file that another program has open.

Python converts only a few of them to a value of errno."""
_WINERROR_TEXTS = {
    **dict.fromkeys((32, 33, 1224), "another program has it open"),
    **dict.fromkeys((39, 112), os.strerror(errno.ENOSPC)),
    **dict.fromkeys((8, 14, 1450, 1455), os.strerror(errno.ENOMEM)),
    206: os.strerror(errno.ENAMETOOLONG),
}
MAX_SENTENCE_LENGTH = 1000
"""Largest number of characters of a message, because it may quote text of any length from an untrusted file."""
_CONTROL_CHARACTERS = r"[\x00-\x1f\x7f-\x9f\u2028\u2029]"


def to_single_line(text: str) -> str:
    """Shorten a text and escape its control characters, so that a terminal shows it as one line."""
    if len(text) > MAX_SENTENCE_LENGTH:
        half_length = MAX_SENTENCE_LENGTH // 2
        text = f"{text[:half_length]} […] {text[-half_length:]}"
    return re.sub(_CONTROL_CHARACTERS, lambda match: repr(match.group())[1:-1], text)


def os_error_text(error: OSError) -> str:
    """Return the operating system's description of an error, always in English; Windows would translate it."""
    winerror = getattr(error, "winerror", None)
    if not winerror:
        return error.strerror or str(error)
    # Python reports EINVAL for a Windows error that has no equivalent errno.
    default_text = f"error {winerror} of Windows" if error.errno == errno.EINVAL else os.strerror(error.errno)
    return _WINERROR_TEXTS.get(winerror, default_text)


class FDDAError(Exception):
    """Base of all errors whose text is shown to the user; the command line exits with `exit_status`."""

    exit_status = 1

    def __str__(self) -> str:
        return to_single_line(super().__str__())


def exit_status(error: BaseException) -> int:
    """Return the exit status of the command line for an error: `TRY_AGAIN` where the machine caused it."""
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
    """Return a message for an unexpected error that the machine caused; empty where it may be a bug."""
    if isinstance(error, MemoryError):
        return "The memory of this machine is used up; free some, or use a larger one."
    if isinstance(error, OSError) and _is_machine_fault(error):
        name = f"'{error.filename}': " if error.filename else ""
        return f"{name}{os_error_text(error)}; make room, end other programs, or try again."
    return ""


def _is_machine_fault(error: OSError) -> bool:
    return error.errno in MACHINE_ERRNOS or getattr(error, "winerror", None) in MACHINE_WINERRORS


class WrongUsageError(FDDAError):
    """Options are wrong or contradict each other. The argument parser writes the text, which may have several lines."""

    exit_status = 2
    __str__ = Exception.__str__


class RigError(FDDAError):
    """The scene has no rig that can be recorded, bound or evaluated."""


class RecordingError(FDDAError):
    """A recording cannot be read, resumed or written."""


class BusyError(RecordingError):
    """Another process uses the recording."""

    exit_status = TRY_AGAIN


class ModelError(FDDAError):
    """A model cannot be read, or was trained for another rig."""


class TrainingError(FDDAError):
    """The training could not start, ended unexpectedly, or reported a failure."""


class TrainingDiedError(TrainingError):
    """Another program ended the training, or memory or disk space ran out."""

    exit_status = TRY_AGAIN


class TrainerEnvironmentError(FDDAError):
    """The Python environment of the trainer cannot be created, removed or used."""


class OutputError(FDDAError):
    """An output path cannot be written."""


class DiskFullError(OutputError):
    """The disk has too little free space."""

    exit_status = TRY_AGAIN
