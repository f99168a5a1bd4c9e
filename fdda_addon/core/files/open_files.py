# SPDX-License-Identifier: GPL-3.0-or-later
"""Replacing, removing and opening of files that other programs may have open.

Windows refuses all three while a virus scanner, an indexer or another Blender has the file open, often only briefly.
"""

import errno
import os
import random
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

RETRY_SECONDS = 10.0
OPEN_RETRY_SECONDS = 1.0
"""How long an operation is retried before a file counts as in use. The time for opening is shorter, because the cause
may be missing permission."""
MAX_PAUSE_SECONDS = 0.1
SHARING_WINERRORS = {5, 32, 33, 1224}
"""Windows error numbers: access denied, sharing violation, lock violation, and user-mapped file."""

Result = TypeVar("Result")


def replace_file(source: Path, target: Path) -> None:
    """Rename a file to another path; a file at that path is replaced.

    Raises:
        OSError: `os.replace` raised it; EBUSY where another program has a file open for longer than `RETRY_SECONDS`.
    """
    _change(target, lambda: os.replace(source, target))


def remove_file(path: Path) -> None:
    """Remove a file where it exists; raises errors as `replace_file` does."""
    _change(path, lambda: path.unlink(missing_ok=True))


def open_with_retry(open_file: Callable[[], Result]) -> Result:
    """Call a function that opens a file, and retry while Windows refuses it."""
    # The exception of `open` lacks the error number of Windows.
    return _retry(open_file, OPEN_RETRY_SECONDS, lambda _: os.name == "nt")


def _change(path: Path, action: Callable[[], None]) -> None:
    def is_in_use(error: PermissionError) -> bool:
        # Windows refuses a folder and a write-protected file permanently.
        is_permanent = os.path.isdir(path) or (os.path.lexists(path) and not os.access(path, os.W_OK))
        return getattr(error, "winerror", None) in SHARING_WINERRORS and not is_permanent

    try:
        _retry(action, RETRY_SECONDS, is_in_use)
    except PermissionError as error:
        if not is_in_use(error):
            raise
        raise OSError(errno.EBUSY, "another program has it open", str(path)) from error


def _retry(action: Callable[[], Result], seconds: float, is_in_use: Callable[[PermissionError], bool]) -> Result:
    deadline = time.monotonic() + seconds
    while True:
        try:
            return action()
        except PermissionError as error:
            if not is_in_use(error) or time.monotonic() > deadline:
                raise
        # With a constant pause, each attempt might coincide with a program that opens the file at regular intervals.
        time.sleep(random.uniform(0.1, 1) * MAX_PAUSE_SECONDS)
