# SPDX-License-Identifier: GPL-3.0-or-later
"""One writer at a time for a recording: a file in its folder that names the process."""

import contextlib
import json
import os
import socket
import sys
import time
from pathlib import Path

from .errors import RecordingError

LOCK = "recording.lock"
UNREADABLE_SECONDS = 10.0
"""A lock that names no process is being written, or, when it is older, was torn."""

_held: set[Path] = set()


class RecordingLock:
    """The right to write into a folder, from `acquire` to `release`."""

    def __init__(self, folder: Path):
        self._folder = folder
        self._path = folder.absolute() / LOCK
        self.is_held = False

    def acquire(self) -> None:
        """Take the lock; one that was left by a process that is gone is taken over.

        Raises:
            RecordingError: another process has it.
            OSError: the folder cannot be written.
        """
        if not self._create():
            owner = self._owner()
            if owner is not None:
                raise RecordingError(
                    f"{owner} is recording into '{self._folder}'; wait for it, or choose another folder. "
                    f"If that is not so, remove '{LOCK}' there."
                )
            with contextlib.suppress(FileNotFoundError):
                self._path.unlink()
            if not self._create():
                raise RecordingError(f"Another process began to record into '{self._folder}'; choose another folder.")

    def release(self) -> None:
        """Give the lock back, if this has it."""
        if self.is_held:
            self.is_held = False
            _held.discard(self._path)
            with contextlib.suppress(OSError):
                self._path.unlink()

    def _create(self) -> bool:
        try:
            handle = os.open(self._path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644)
        except FileExistsError:
            return False
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            json.dump({"pid": os.getpid(), "host": socket.gethostname()}, file)
        self.is_held = True
        _held.add(self._path)
        return True

    def _owner(self) -> str | None:
        """Who has the lock, for a sentence; None when nobody has."""
        try:
            owner = json.loads(self._path.read_text(encoding="utf-8"))
            pid, host = int(owner["pid"]), str(owner["host"])
        except FileNotFoundError:
            return None
        except (ValueError, KeyError, TypeError, OverflowError):
            age = time.time() - self._path.stat().st_mtime
            return "Another process" if age < UNREADABLE_SECONDS else None
        if host != socket.gethostname():
            return f"Another Blender (process {pid} on '{host}')"
        if pid == os.getpid():
            return "This Blender" if self._path in _held else None
        return f"Another Blender (process {pid})" if _is_alive(pid) else None


def _is_alive(pid: int) -> bool:
    if pid <= 0:
        return False
    if sys.platform == "win32":
        import ctypes

        # Signal 0 ends a process there. PROCESS_QUERY_LIMITED_INFORMATION; 259 is STILL_ACTIVE.
        kernel = ctypes.windll.kernel32
        process, status = kernel.OpenProcess(0x1000, False, pid), ctypes.c_ulong()
        alive = bool(process) and bool(kernel.GetExitCodeProcess(process, ctypes.byref(status))) and status.value == 259
        kernel.CloseHandle(process)
        return alive
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True
