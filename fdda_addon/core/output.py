# SPDX-License-Identifier: GPL-3.0-or-later
"""Writing files so that a reader finds the old one, the new one, or none; never a half."""

import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from .errors import OutputError


def check_writable(path: Path) -> None:
    """Fail before the work rather than after it when a file could not be written.

    Raises:
        OutputError: the folder does not exist or cannot be written, or the path is a folder or a device.
    """
    # os.path: the methods of Path raise for a folder that may not be entered.
    folder = path.parent
    if os.path.isdir(path):
        raise OutputError(f"Cannot write '{path}': it is a folder; give the name of a file.")
    if os.path.exists(path) and not os.path.isfile(path):
        # A rename would put a file in the place of /dev/null.
        raise OutputError(f"Cannot write '{path}': it is no ordinary file; give the name of a file.")
    if not os.path.isdir(folder):
        raise OutputError(f"Cannot write '{path}': the folder '{folder}' does not exist; create it first.")
    _probe(path, folder)


def check_folder_writable(path: Path) -> None:
    """Fail before the work rather than after it when files could not be written into a folder that may not exist yet.

    Raises:
        OutputError: the folder, or the nearest one above it that exists, cannot be written, or it is a file.
    """
    folder = path
    while not os.path.exists(folder):
        folder = folder.parent
    if not os.path.isdir(folder):
        raise OutputError(f"Cannot write into '{path}': '{folder}' is a file; choose another folder.")
    _probe(path, folder)


def _probe(path: Path, folder: Path) -> None:
    try:
        handle, probe = tempfile.mkstemp(prefix=".fdda-", dir=folder)
    except OSError as error:
        raise OutputError(f"Cannot write '{path}': {error.strerror}; choose a folder that you may write.") from error
    os.close(handle)
    os.unlink(probe)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary path beside `path`, and rename it to `path` when the block ends without an error.

    Raises:
        OutputError: the file cannot be written or renamed, for instance because the disk is full.
    """
    temporary = path.with_name(f".{os.getpid()}-{path.name}")
    try:
        yield temporary
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise OutputError(f"Cannot write '{path}': {error.strerror or error}; nothing was changed.") from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def write_text(path: Path, text: str) -> None:
    """Replace a file with text, UTF-8.

    Raises:
        OutputError: as `replacing`.
    """
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, value: object) -> None:
    """Replace a file with JSON; NaN and infinity are refused.

    Raises:
        OutputError: as `replacing`.
    """
    write_text(path, json.dumps(value, indent=1, allow_nan=False) + "\n")
