# SPDX-License-Identifier: GPL-3.0-or-later
"""Lock file of a recording folder, which permits one writer at a time.

The content of the file serves only to name the owner in messages.
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
from ..file_lock import try_lock

LOCK_NAME = "recording.lock"
MAX_OWNER_BYTES = 1000
_OPTIONAL_FLAGS = (getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC", "O_BINARY"))
_OPEN_FLAGS = os.O_RDWR | os.O_CREAT | sum(_OPTIONAL_FLAGS)

_held_lock_paths: set[Path] = set()


class RecordingLock:
    """Lock of a folder for one writer, held from `acquire` to `release`."""

    def __init__(self, folder: Path):
        self._folder = folder
        self._path = folder.absolute() / LOCK_NAME
        self._handle = -1

    @property
    def is_held(self) -> bool:
        return self._handle >= 0

    def acquire(self) -> None:
        """Acquire the lock. A lock file that an ended process left behind does not block it.

        Raises:
            BusyError: another process holds the lock.
            OSError: the folder cannot be written, or its file system has no locks.
        """
        while True:
            handle = os.open(self._path, _OPEN_FLAGS, 0o666)
            try:
                if not stat.S_ISREG(os.fstat(handle).st_mode):
                    raise OSError(errno.EINVAL, f"'{LOCK_NAME}' is not a regular file")
                if not try_lock(handle):
                    raise BusyError(
                        f"{self._owner(handle)} is recording into '{self._folder}'; wait for it, or choose another "
                        "folder."
                    )
                if self._is_current_file(handle):
                    break
            except BaseException:
                os.close(handle)
                raise
            # The previous owner has removed the file since it was opened.
            os.close(handle)
        self._handle = handle
        _held_lock_paths.add(self._path)
        # A full disk may refuse the content, which the lock does not need.
        with contextlib.suppress(OSError):
            os.ftruncate(handle, 0)
            os.write(handle, json.dumps({"pid": os.getpid(), "host": socket.gethostname()}).encode())

    def release(self) -> None:
        """Release the lock where it is held."""
        if not self.is_held:
            return
        _held_lock_paths.discard(self._path)
        # Remove the file while the lock is still held, so that it is not the file of another owner. Windows refuses to
        # remove an open file, so there the file is removed after it is closed.
        with contextlib.suppress(OSError):
            self._path.unlink()
        os.close(self._handle)
        self._handle = -1
        if sys.platform == "win32":
            with contextlib.suppress(OSError):
                self._path.unlink()

    def _is_current_file(self, handle: int) -> bool:
        try:
            return os.path.samestat(os.fstat(handle), os.lstat(self._path))
        except FileNotFoundError:
            return False

    def _owner(self, handle: int) -> str:
        """Describe the owner of the lock for a message."""
        if self._path in _held_lock_paths:
            return "This Blender"
        try:
            os.lseek(handle, 0, os.SEEK_SET)
            owner = json.loads(os.read(handle, MAX_OWNER_BYTES))
            pid, host = int(owner["pid"]), str(owner["host"])[:80]
        except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
            return "Another process"
        return f"Another Blender (process {pid}{'' if host == socket.gethostname() else f' on {host!r}'})"
