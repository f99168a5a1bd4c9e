# SPDX-License-Identifier: GPL-3.0-or-later
"""Differences between operating systems: marks that skip tests with a reason, and expected error messages."""

import errno
import os
import sys

import pytest


def _missing_drive() -> str:
    """Return the path of a drive that does not exist on this Windows."""
    return next(f"{letter}:\\" for letter in "QRSTUVWXY" if not os.path.exists(f"{letter}:\\"))


WINDOWS = sys.platform == "win32"
KILLED = 1 if WINDOWS else -9
"""Return code of a `subprocess.Popen` after its method `kill`."""
UNWRITABLE = f"{_missing_drive()}fdda" if WINDOWS else "/proc/fdda"
"""A path where nobody can create a file, not even an administrator."""
NO_FILE_SIZE_LIMITS = "Windows cannot limit the size of files that a process writes."

NOT_FOUND = os.strerror(errno.ENOENT)
"""Part of the error message for a file that does not exist."""
BELOW_A_FILE = os.strerror(errno.ENOENT if WINDOWS else errno.ENOTDIR)
"""Part of the error message for a path below a file."""

NO_LOCKS_ERRNOS = [errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL, 45]
"""Values of errno for a file system without locks; 45 is ENOTSUP of macOS."""


def refuse_locks(monkeypatch: pytest.MonkeyPatch, number: int = errno.ENOLCK) -> None:
    """Let locks fail as on a drive that has none."""

    def lock(*_: int) -> None:
        raise OSError(number, "Operation not supported")

    monkeypatch.setattr(*(("msvcrt.locking", lock) if WINDOWS else ("fcntl.flock", lock)))


symbolic_links = pytest.mark.skipif(WINDOWS, reason="Windows lets only administrators make symbolic links.")
named_pipes = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="Windows has no named pipes in folders.")
forks = pytest.mark.skipif(not hasattr(os, "fork"), reason="Windows does not fork processes.")
sparse_files = pytest.mark.skipif(WINDOWS, reason="On Windows, Python writes all zeros of a sparse file to the disk.")
drives = pytest.mark.skipif(not WINDOWS, reason="Only Windows has drives in paths.")
