# SPDX-License-Identifier: GPL-3.0-or-later
"""The exit status of an error: a farm runs again what failed for a reason of the machine's, and nothing else."""

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
from fdda_addon.core.output import atomic_write


def caused_by(cause: BaseException) -> OutputError:
    try:
        raise OutputError("It failed.") from cause
    except OutputError as error:
        return error


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.ENOMEM, errno.ESTALE])
def test_what_the_machine_caused_may_be_tried_again(number):
    assert exit_status(caused_by(OSError(number, "text"))) == TRY_AGAIN
    assert exit_status(caused_by(caused_by(OSError(number, "text")))) == TRY_AGAIN


@pytest.mark.parametrize("number", [32, 33, 39, 112, 1224, 1455])
def test_what_windows_says_of_the_machine(number):
    error = OSError(errno.EINVAL, "in the language of the system")
    error.winerror = number
    assert exit_status(caused_by(error)) == TRY_AGAIN
    assert os_error_text(error) != error.strerror and os_error_text(error).isascii()


def test_what_windows_says_is_not_quoted():
    error = PermissionError(errno.EACCES, "Zugriff verweigert")
    error.winerror = 5
    assert os_error_text(error) == "Permission denied" and exit_status(caused_by(error)) == 1
    assert os_error_text(OSError(errno.EINVAL, "it is not a regular file")) == "it is not a regular file"


@pytest.mark.parametrize("number", [errno.ENOENT, errno.EACCES, errno.EISDIR, errno.EROFS, errno.ENAMETOOLONG])
def test_what_the_user_caused_will_never_work(number):
    assert exit_status(caused_by(OSError(number, "text"))) == 1


def test_errors_that_say_so_themselves():
    assert [exit_status(kind("text")) for kind in (BusyError, DiskFullError, TrainingDiedError)] == [TRY_AGAIN] * 3
    assert exit_status(RigError("text")) == 1 and exit_status(WrongUsageError("text")) == 2
    assert exit_status(caused_by(MemoryError())) == TRY_AGAIN


def test_a_full_disk_through_the_writer_of_files(tmp_path):
    with pytest.raises(OutputError) as failed, atomic_write(tmp_path / "a.json"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert exit_status(failed.value) == TRY_AGAIN and list(tmp_path.iterdir()) == []
