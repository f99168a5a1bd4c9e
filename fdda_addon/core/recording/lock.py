# SPDX-License-Identifier: GPL-3.0-or-later
"""Lock file of a recording folder, which permits one writer at a time.

On a drive that cannot lock files, the existence of the file is the lock.
"""

import contextlib
import errno
import os
import stat
import sys
from pathlib import Path

from ..errors import BusyError
from ..files.file_lock import NoLocksError, try_lock

LOCK_NAME = "recording.lock"
_OPTIONAL_FLAGS = (getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC", "O_BINARY"))
_OPEN_FLAGS = os.O_RDWR | sum(_OPTIONAL_FLAGS)


class RecordingLock:
    """Lock of a folder for one writer, held from `acquire` to `release`."""

    def __init__(self, folder: Path):
        self._folder = folder
        self._path = folder.absolute() / LOCK_NAME
        self._handle = -1
        self.note = ""
        """A sentence for the user about a drive that cannot lock files; else empty."""

    @property
    def is_held(self) -> bool:
        return self._handle >= 0

    def acquire(self) -> None:
        """Acquire the lock. A lock file that an ended process left behind blocks it only where files have no locks.

        Raises:
            BusyError: another process holds the lock.
            OSError: the folder cannot be written.
        """
        while True:
            try:
                handle, is_new = os.open(self._path, _OPEN_FLAGS | os.O_CREAT | os.O_EXCL, 0o666), True
            except FileExistsError:
                try:
                    handle, is_new = os.open(self._path, _OPEN_FLAGS), False
                except FileNotFoundError:
                    continue
            try:
                if not stat.S_ISREG(os.fstat(handle).st_mode):
                    raise OSError(errno.EINVAL, f"'{LOCK_NAME}' is not a regular file")
                advice = "wait for it, or choose another folder"
                try:
                    is_locked = try_lock(handle)
                except NoLocksError:
                    is_locked = is_new
                    advice = f"wait for it, or remove '{LOCK_NAME}' there if it has ended: the drive cannot lock files"
                    self.note = (
                        f"The drive of '{self._folder}' cannot lock files; the file '{LOCK_NAME}' there keeps other "
                        "recordings out. Remove it after a recording whose process was ended."
                    )
                if not is_locked:
                    raise BusyError(f"Another job is recording into '{self._folder}'; {advice}.")
                if self._is_current_file(handle):
                    break
            except BaseException:
                os.close(handle)
                raise
            # The previous owner has removed the file since it was opened.
            os.close(handle)
        self._handle = handle

    def release(self) -> None:
        """Release the lock where it is held."""
        if not self.is_held:
            return
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
