# SPDX-License-Identifier: GPL-3.0-or-later
"""One writer at a time for a recording: a file in its folder that the writer has locked.

The operating system keeps the lock, as for the locks of the package `filelock`: it ends with the process however that
ends, and nothing depends on what the file says. That is only for the sentence that the other process is told.
"""

import contextlib
import errno
import json
import os
import socket
import stat
import sys
from pathlib import Path

from ..errors import BusyError

LOCK = "recording.lock"
MAX_BYTES = 1000
_FLAGS = (getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC", "O_BINARY"))
_OPEN = os.O_RDWR | os.O_CREAT | sum(_FLAGS)
LOCKED_BYTE = 1 << 30
"""Windows lets nobody read what is locked: a byte that no file has."""

_held: set[Path] = set()


class RecordingLock:
    """The right to write into a folder, from `acquire` to `release`."""

    def __init__(self, folder: Path):
        self._folder = folder
        self._path = folder.absolute() / LOCK
        self._handle = -1

    @property
    def is_held(self) -> bool:
        return self._handle >= 0

    def acquire(self) -> None:
        """Take the lock; a file that a process has left behind which is gone is no lock.

        Raises:
            BusyError: another process has it.
            OSError: the folder cannot be written, or its disk knows no locks.
        """
        while True:
            handle = os.open(self._path, _OPEN, 0o666)
            try:
                if not stat.S_ISREG(os.fstat(handle).st_mode):
                    raise OSError(errno.EINVAL, f"'{LOCK}' is not a regular file")
                if not _lock(handle):
                    raise BusyError(
                        f"{self._owner(handle)} is recording into '{self._folder}'; wait for it, or choose another "
                        "folder."
                    )
                if self._is_in_place(handle):
                    break
            except BaseException:
                os.close(handle)
                raise
            # Whoever had it has removed the file meanwhile.
            os.close(handle)
        self._handle = handle
        _held.add(self._path)
        # On a full disk the lock holds too.
        with contextlib.suppress(OSError):
            os.ftruncate(handle, 0)
            os.write(handle, json.dumps({"pid": os.getpid(), "host": socket.gethostname()}).encode())

    def release(self) -> None:
        """Give the lock back, if this has it."""
        if not self.is_held:
            return
        _held.discard(self._path)
        # While it is locked: nobody else's file can be there. Windows removes no open file.
        with contextlib.suppress(OSError):
            self._path.unlink()
        os.close(self._handle)
        self._handle = -1
        if sys.platform == "win32":
            with contextlib.suppress(OSError):
                self._path.unlink()

    def _is_in_place(self, handle: int) -> bool:
        try:
            return os.path.samestat(os.fstat(handle), os.lstat(self._path))
        except FileNotFoundError:
            return False

    def _owner(self, handle: int) -> str:
        """Who has the lock, for a sentence."""
        if self._path in _held:
            return "This Blender"
        try:
            os.lseek(handle, 0, os.SEEK_SET)
            owner = json.loads(os.read(handle, MAX_BYTES))
            pid, host = int(owner["pid"]), str(owner["host"])[:80]
        except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
            return "Another process"
        return f"Another Blender (process {pid}{'' if host == socket.gethostname() else f' on {host!r}'})"


def _lock(handle: int) -> bool:
    """Lock an open file; False when somebody else has."""
    if sys.platform == "win32":
        import msvcrt

        os.lseek(handle, LOCKED_BYTE, os.SEEK_SET)
        try:
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        except PermissionError:
            return False
        finally:
            os.lseek(handle, 0, os.SEEK_SET)
        return True
    import fcntl

    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
