# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks of the folder into which a recording is written, and removal of the files of a recording."""

import os
from pathlib import Path

from ..errors import OutputError, RecordingError, os_error_text
from ..files.file_kind import RECORDING
from ..files.open_files import remove_file
from ..files.output import check_folder_writable, is_temporary_name
from .arrays import ARRAY_NAMES, STREAMED_ARRAY_NAMES
from .index import BONES_NAME, INDEX_NAME
from .lock import LOCK_NAME, RecordingLock
from .reader import check_resumable

RECORDING_FILES = (
    *(f"{name}.npy" for name in sorted(ARRAY_NAMES, key=STREAMED_ARRAY_NAMES.__contains__, reverse=True)),
    BONES_NAME,
)
"""Names of the files but the index. Arrays that a training keeps open come first: Windows refuses to remove them."""


def check_recordable(path: Path, resume: bool, overwrite: bool = False) -> None:
    """Check before a long job that a recording can be started or resumed.

    Args:
        path: the folder.
        resume: continue the recording in the folder.
        overwrite: replace the recording in the folder.

    Raises:
        OutputError: the folder has other files, or cannot be written.
        RecordingError: the folder has a recording and neither `resume` nor `overwrite` is set, the recording is
            damaged, or another process writes it.
    """
    check_folder_writable(path, (*RECORDING_FILES, INDEX_NAME))
    check_folder(path, resume, overwrite)
    if os.path.lexists(path / LOCK_NAME):
        lock = RecordingLock(path)
        try:
            lock.acquire()
        except OSError as error:
            raise OutputError(f"Cannot record into '{path}': {os_error_text(error)}; choose another.") from error
        lock.release()
    if os.path.exists(path / INDEX_NAME) and not overwrite:
        check_resumable(path)


def check_folder(path: Path, resume: bool, overwrite: bool = False) -> None:
    """Check a folder as `check_recordable` does, but neither its arrays nor its lock.

    Raises:
        OutputError: the folder has other files.
        RecordingError: the folder has a recording, and neither `resume` nor `overwrite` is set.
    """
    if not os.path.exists(path / INDEX_NAME):
        if not is_available(path):
            raise OutputError(f"Cannot record into '{path}': it is not an empty folder; choose another.")
    elif overwrite and not is_recording(path):
        raise OutputError(
            f"Cannot record into '{path}': its '{INDEX_NAME}' is of something else; choose another folder."
        )
    elif not resume and not overwrite:
        raise RecordingError(
            f"'{path}' holds a recording already; continue it with --resume, replace it with --overwrite, or choose "
            "another folder."
        )


def is_available(path: Path) -> bool:
    """Return whether a folder is missing, empty, or has only what a recording writes before its index."""
    if not os.path.exists(path):
        return True
    return os.path.isdir(path) and all(
        name in (LOCK_NAME, BONES_NAME) or is_temporary_name(name) for name in os.listdir(path)
    )


def is_recording(path: Path) -> bool:
    """Return whether a folder has a recording, possibly damaged: an index with the right signature, or the arrays."""
    try:
        if RECORDING.matches(path / INDEX_NAME):
            return True
    except OSError:
        return False
    return all(os.path.isfile(path / f"{name}.npy") for name in STREAMED_ARRAY_NAMES[:2])


def remove_temporary_files(path: Path) -> None:
    """Remove temporary files of a process that was killed while writing the index.

    Raises:
        OSError: a file cannot be removed.
    """
    for name in os.listdir(path):
        if is_temporary_name(name):
            remove_file(path / name)


def remove_recording_files(path: Path) -> None:
    """Remove the files of a recording; the caller holds the lock.

    Raises:
        OSError: a file cannot be removed.
    """
    for name in RECORDING_FILES:
        remove_file(path / name)
    remove_temporary_files(path)
    # The index is removed last, so that an interrupted removal leaves a folder that is still recognized as a recording.
    remove_file(path / INDEX_NAME)
