# SPDX-License-Identifier: GPL-3.0-or-later
"""The folder that a recording is written into: what may be in it before, and what is removed from it."""

import os
from pathlib import Path

from ..errors import OutputError, RecordingError, os_error_text
from ..file_kind import RECORDING
from ..open_files import remove_file
from ..output import check_folder_writable, is_temporary_name
from .arrays import ARRAYS, STREAMED
from .index import INDEX
from .lock import LOCK, RecordingLock
from .reader import check_resumable

FILES = tuple(f"{name}.npy" for name in sorted(ARRAYS, key=STREAMED.__contains__, reverse=True))
"""The arrays of a recording. First those that a training has open, which Windows does not remove meanwhile."""


def check_recordable(path: Path, resume: bool, overwrite: bool = False) -> None:
    """Fail before the work where a recording cannot be begun, or what is to be resumed is damaged.

    Args:
        path: the folder.
        resume: go on with the recording in it.
        overwrite: replace the recording in it.

    Raises:
        OutputError: the folder holds something else, or cannot be written.
        RecordingError: there is a recording and neither is set, it is damaged, or another process writes it.
    """
    check_folder_writable(path, (*FILES, INDEX))
    check_place(path, resume, overwrite)
    if os.path.lexists(path / LOCK):
        lock = RecordingLock(path)
        try:
            lock.acquire()
        except OSError as error:
            raise OutputError(f"Cannot record into '{path}': {os_error_text(error)}; choose another.") from error
        lock.release()
    if os.path.exists(path / INDEX) and not overwrite:
        check_resumable(path)


def check_place(path: Path, resume: bool, overwrite: bool = False) -> None:
    """As `check_recordable`, without a look into the files.

    Raises:
        OutputError: the folder holds something else.
        RecordingError: there is a recording, and neither `resume` nor `overwrite` is set.
    """
    if not os.path.exists(path / INDEX):
        if not is_free(path):
            raise OutputError(f"Cannot record into '{path}': it is not an empty folder; choose another.")
    elif overwrite and not is_recording(path):
        raise OutputError(f"Cannot record into '{path}': its '{INDEX}' is of something else; choose another folder.")
    elif not resume and not overwrite:
        raise RecordingError(
            f"'{path}' holds a recording already; continue it with --resume, replace it with --overwrite, or choose "
            "another folder."
        )


def is_free(path: Path) -> bool:
    """Whether a folder can be recorded into: it is not there, or holds nothing but what an interruption has left."""
    if not os.path.exists(path):
        return True
    return os.path.isdir(path) and all(name == LOCK or is_temporary_name(name) for name in os.listdir(path))


def is_recording(path: Path) -> bool:
    """Whether a folder holds a recording, however damaged: its index begins as one, or the arrays of one are there."""
    try:
        if RECORDING.matches(path / INDEX):
            return True
    except OSError:
        return False
    return all(os.path.isfile(path / f"{name}.npy") for name in STREAMED[:2])


def remove_left_over(path: Path) -> None:
    """Remove what a process has left that was ended while it wrote the index.

    Raises:
        OSError: a file cannot be removed.
    """
    for name in os.listdir(path):
        if is_temporary_name(name):
            remove_file(path / name)


def remove_files(path: Path) -> None:
    """Remove the files of a recording; whoever calls it has locked the folder.

    Raises:
        OSError: a file cannot be removed.
    """
    for name in FILES:
        remove_file(path / name)
    remove_left_over(path)
    # The index last: what is left of an interruption is still seen to be a recording.
    remove_file(path / INDEX)
