# SPDX-License-Identifier: GPL-3.0-or-later
"""State and checks of a recording folder, and removal of a recording."""

import enum
import os
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from ..errors import OutputError, RecordingError, os_error_text
from ..files.file_kind import RECORDING
from ..files.open_files import remove_file
from ..files.output import check_folder_writable, is_temporary_name
from ..rig import Rig, read_joints, read_meshes, rig_differences
from .arrays import ARRAY_NAMES, STREAMED_ARRAY_NAMES
from .index import (
    ALONE,
    BONES_NAME,
    INDEX_NAME,
    REFINED,
    find_different_keys,
    read_index,
    read_info,
    repeatability_sentence,
)
from .lock import LOCK_NAME, RecordingLock
from .reader import check_resumable

SETTING_LABELS = {"limits": "range of motion", "sources": "number of poses or actions"}
"""Labels of sampling keys in messages."""


RECORDING_FILES = (
    *(f"{name}.npy" for name in sorted(ARRAY_NAMES, key=STREAMED_ARRAY_NAMES.__contains__, reverse=True)),
    BONES_NAME,
)
"""Names of the files but the index. Arrays that a training keeps open come first: Windows refuses to remove them."""


def check_recordable(path: Path, resume: bool, overwrite: bool = False) -> None:
    """Check before a long job that a recording can be started or resumed.

    Args:
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


class FolderState(enum.Enum):
    """State of a recording folder."""

    FREE = "free"
    """The folder is empty or missing: a recording can be written into it."""
    INCOMPLETE = "incomplete"
    """The folder has an incomplete recording of this rig with these settings."""
    COMPLETE = "complete"
    """The folder has a complete recording of this rig."""
    OTHER = "other"
    """The folder has a recording of another rig, or an incomplete recording with other settings."""
    FOREIGN = "foreign"
    """The folder has other files, or a recording that cannot be read."""


@dataclass(frozen=True)
class FolderContent:
    """Content of a recording folder.

    Attributes:
        state: state of the folder.
        complete, poses: number of complete poses and of all poses of the recording.
        alone_poses: number of the poses of a complete recording in which one input moves alone.
        sentence: a sentence that describes a problem; may be empty.
        measured_sentence: sentence about the repeatability of the target; may be empty.
        is_recording: whether the folder has a recording, possibly damaged, that can be removed.
    """

    state: FolderState
    complete: int = 0
    poses: int = 0
    sentence: str = ""
    measured_sentence: str = ""
    is_recording: bool = False
    alone_poses: int = 0


def read_folder(path: Path, rig: Rig | None = None, sampling: dict | None = None) -> FolderContent:
    """Read the state of a recording folder.

    Args:
        path: the folder, which may be missing.
        rig: the rig to compare with; None skips the comparison.
        sampling: `Sampling.to_json` to compare with; None skips the comparison.
    """
    content = _read_content(path, rig, sampling)
    return replace(content, is_recording=content.state is not FolderState.FREE and is_recording(path))


def _read_content(path: Path, rig: Rig | None, sampling: dict | None) -> FolderContent:
    if not os.path.exists(path / INDEX_NAME):
        if not is_available(path):
            return FolderContent(FolderState.FOREIGN, sentence=f"'{path.name}' is not an empty folder; choose another.")
        return FolderContent(FolderState.FREE)
    try:
        index = read_index(path)
    except RecordingError as error:
        return FolderContent(FolderState.FOREIGN, sentence=str(error))
    pose_counts = index["complete"], index["poses"]
    # The rest matrices are in an array; they are compared when the recording is used.
    if rig is not None and (
        rig_clauses := rig_differences(
            read_joints(index["joints"]), rig.rest_matrices, read_meshes(index["meshes"]), rig
        )
    ):
        return FolderContent(
            FolderState.OTHER,
            *pose_counts,
            f"'{path.name}' holds a recording of another rig: {'; '.join(rig_clauses)}. Choose another "
            "folder, or remove it.",
        )
    # Some poses do not follow from the settings alone.
    sources = [source for source in index["sampling"]["sources"] if source["kind"] not in (ALONE, REFINED)]
    planned = index["sampling"] | {"sources": sources}
    different_keys = find_different_keys(planned, sampling) if sampling is not None else []
    setting_names = ", ".join(sorted({SETTING_LABELS.get(key.partition(".")[0], key) for key in different_keys}))
    if pose_counts[0] == pose_counts[1]:
        sentence = f"It was recorded with other settings than those above: {setting_names}." if different_keys else ""
        info = read_info(index)
        measured_sentence = repeatability_sentence(info.repeatability_mm)
        return FolderContent(
            FolderState.COMPLETE, *pose_counts, sentence, measured_sentence, alone_poses=len(info.alone_poses)
        )
    if different_keys:
        return FolderContent(
            FolderState.OTHER,
            *pose_counts,
            f"'{path.name}' was begun with other settings ({setting_names}) and has {pose_counts[0]} of "
            f"{pose_counts[1]} poses. Set them as they were to resume, choose another folder, or remove it.",
        )
    return FolderContent(FolderState.INCOMPLETE, *pose_counts)


def is_recorded(path: Path) -> bool:
    """Return whether a folder has a complete recording."""
    try:
        index = read_index(path)
    except RecordingError:
        return False
    return index["complete"] >= index["poses"]


def remove_recording(path: Path) -> None:
    """Remove the files of a recording, and the folder where it has no other files.

    Raises:
        RecordingError: the folder has no recording, or another process writes it.
        OutputError: a file cannot be removed.
    """
    if not os.path.exists(path / INDEX_NAME):
        raise RecordingError(f"'{path}' holds no recording; there is nothing to remove.")
    lock = RecordingLock(path)
    try:
        lock.acquire()
        remove_recording_files(path)
        lock.release()
        # The folder cannot be removed where it has other files, or another program has it open.
        with suppress(OSError):
            path.rmdir()
    except OSError as error:
        name = f", '{os.path.basename(error.filename)}'" if error.filename else ""
        raise OutputError(
            f"Cannot remove the recording '{path}'{name}: {os_error_text(error)}; end what "
            "uses it, a training for example."
        ) from error
    finally:
        lock.release()
