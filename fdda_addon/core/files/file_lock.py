# SPDX-License-Identifier: GPL-3.0-or-later
"""Locks on open files. The operating system releases a lock when no process has the file open anymore.

docs/development.md has the reasons against the package `filelock`.
"""

import errno
import os
import socket
import sys

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

LOCKED_BYTE_OFFSET = 1 << 30
"""Offset of the byte that Windows locks: past the end of the file, because Windows denies reading locked bytes."""


class NoLocksError(OSError):
    """The file system of a file cannot lock it, as some network drives."""


def try_lock(descriptor: int, is_shared: bool = False) -> bool:
    """Lock an open file without waiting; return False if another process holds a lock on it.

    Args:
        descriptor: descriptor of the file. A child process that inherits it also holds the lock, except on Windows.
        is_shared: whether other processes may also hold shared locks; on Windows all locks are exclusive.

    Raises:
        NoLocksError: the file system has no locks.
    """
    try:
        if sys.platform == "win32":
            offset = os.lseek(descriptor, 0, os.SEEK_CUR)
            os.lseek(descriptor, LOCKED_BYTE_OFFSET, os.SEEK_SET)
            try:
                msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
            finally:
                os.lseek(descriptor, offset, os.SEEK_SET)
        else:
            fcntl.flock(descriptor, (fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    except OSError as error:
        if error.errno == errno.EBADF:
            raise
        # Systems and network drives have different values of errno for this.
        raise NoLocksError(error.errno, f"its drive cannot lock files ({error.strerror})") from error
    return True


def has_ended(process_id: int, host: str) -> bool:
    """Return whether a process has ended for certain. Unknown are those of other machines and, on Windows, all."""
    if host != socket.gethostname() or sys.platform == "win32":
        return False
    try:
        os.kill(process_id, 0)
    except (ProcessLookupError, OverflowError):
        return True
    except OSError:
        return False
    return False
