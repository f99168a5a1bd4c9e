# SPDX-License-Identifier: GPL-3.0-or-later
"""State of a recording folder, and removal of a recording."""

import enum
import os
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from ..errors import OutputError, RecordingError, os_error_text
from ..rig import Rig, read_joints, read_meshes, rig_differences
from .folder_check import is_available, is_recording, remove_recording_files
from .index import ALONE, INDEX_NAME, REFINED, find_different_keys, read_index, read_info
from .lock import RecordingLock

SETTING_LABELS = {"limits": "range of motion", "sources": "number of poses or actions"}
"""Labels of sampling keys in messages."""


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
    different_keys = find_different_keys(_planned_sampling(index["sampling"]), sampling) if sampling is not None else []
    setting_names = ", ".join(sorted({SETTING_LABELS.get(key.partition(".")[0], key) for key in different_keys}))
    if pose_counts[0] == pose_counts[1]:
        sentence = f"It was recorded with other settings than those above: {setting_names}." if different_keys else ""
        info = read_info(index)
        measured_sentence = info.repeatability.sentence() if info.repeatability else ""
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


def recordings_in(folder: Path) -> list[Path]:
    """List the recordings in the subfolders of a folder; empty where the folder is a recording itself."""
    if os.path.exists(folder / INDEX_NAME) or not os.path.isdir(folder):
        return []
    return sorted(path for path in folder.iterdir() if os.path.isfile(path / INDEX_NAME))


def _planned_sampling(sampling: dict) -> dict:
    """Return the JSON of a sampling without the poses that do not follow from the settings alone."""
    sources = [source for source in sampling["sources"] if source["kind"] not in (ALONE, REFINED)]
    return {**sampling, "sources": sources}


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
