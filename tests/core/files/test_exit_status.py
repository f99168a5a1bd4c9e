# SPDX-License-Identifier: GPL-3.0-or-later
"""Exit status of an error: a farm runs a job again only if the machine caused the failure."""

import errno

import pytest

from fdda_addon.core.errors import (
    TRY_AGAIN,
    BusyError,
    DiskFullError,
    OutputError,
    RigError,
    TrainingDiedError,
    WrongUsageError,
    exit_status,
    os_error_text,
)


def error_caused_by(cause: BaseException) -> OutputError:
    """Return an error of the add-on whose `__cause__` is the given exception."""
    try:
        raise OutputError("It failed.") from cause
    except OutputError as error:
        return error


@pytest.mark.parametrize("error_code", [errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.ENOMEM, errno.ESTALE])
def test_failures_of_the_machine_may_be_tried_again(error_code):
    assert exit_status(error_caused_by(OSError(error_code, "text"))) == TRY_AGAIN
    assert exit_status(error_caused_by(error_caused_by(OSError(error_code, "text")))) == TRY_AGAIN


@pytest.mark.parametrize("error_code", [32, 33, 39, 112, 1224, 1455])
def test_windows_failures_of_the_machine_may_be_tried_again(error_code):
    error = OSError(errno.EINVAL, "in the language of the system")
    error.winerror = error_code
    assert exit_status(error_caused_by(error)) == TRY_AGAIN
    assert os_error_text(error) != error.strerror and os_error_text(error).isascii()


def test_localized_windows_messages_are_not_quoted():
    error = PermissionError(errno.EACCES, "Zugriff verweigert")
    error.winerror = 5
    assert os_error_text(error) == "Permission denied" and exit_status(error_caused_by(error)) == 1
    assert os_error_text(OSError(errno.EINVAL, "it is not a regular file")) == "it is not a regular file"


@pytest.mark.parametrize("error_code", [errno.ENOENT, errno.EACCES, errno.EISDIR, errno.EROFS, errno.ENAMETOOLONG])
def test_failures_of_the_user_are_not_tried_again(error_code):
    assert exit_status(error_caused_by(OSError(error_code, "text"))) == 1


def test_exit_status_of_error_classes():
    assert [exit_status(kind("text")) for kind in (BusyError, DiskFullError, TrainingDiedError)] == [TRY_AGAIN] * 3
    assert exit_status(RigError("text")) == 1 and exit_status(WrongUsageError("text")) == 2
    assert exit_status(error_caused_by(MemoryError())) == TRY_AGAIN
