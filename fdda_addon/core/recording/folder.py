# SPDX-License-Identifier: GPL-3.0-or-later
"""What is in the folder of a recording: said before anything is recorded, and removed on request."""

import enum
import os
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from ..errors import OutputError, RecordingError, os_error_text
from ..rig import Fingerprint, Rig, read_joints, rig_differences
from .index import INDEX, REFINED, read_index, read_info
from .lock import RecordingLock
from .place import is_free, is_recording, remove_files
from .writer import different_keys

SETTINGS = {"limits": "range of motion", "sources": "number of poses or actions", "fit": "linear skinning"}
"""What people call the keys of a sampling."""


class FolderState(enum.Enum):
    """What a folder holds."""

    FREE = "free"
    """Nothing: it can be recorded into."""
    INCOMPLETE = "incomplete"
    """A recording of this rig with these settings that was broken off."""
    COMPLETE = "complete"
    """A recording of this rig."""
    OTHER = "other"
    """A recording of another rig, or an incomplete one with other settings."""
    FOREIGN = "foreign"
    """Something else, or a recording that cannot be read."""


@dataclass(frozen=True)
class FolderContent:
    """What a folder holds.

    Attributes:
        state: in short.
        complete, poses: of the recording in it, how many there are and how many there will be.
        sentence: where it is not as it should be.
        measured: sentences of what was measured with the poses: the gain of fitted weights, two ways to the same pose.
        is_recording: there is a recording in it, however damaged, that can be removed.
    """

    state: FolderState
    complete: int = 0
    poses: int = 0
    sentence: str = ""
    measured: tuple[str, ...] = ()
    is_recording: bool = False


def read_folder(
    path: Path, rig: Rig | None = None, sampling: dict | None = None, fit_linear: str | None = None
) -> FolderContent:
    """Look into the folder of a recording.

    Args:
        path: the folder, which need not exist.
        rig: the rig at hand; None leaves the comparison out.
        sampling: `Sampling.to_json` of what would be recorded; None leaves the comparison out.
        fit_linear: kind of the skin weights that would be fitted, empty for the rig's own; None leaves it out.
    """
    content = _content(path, rig, sampling, fit_linear)
    return replace(content, is_recording=content.state is not FolderState.FREE and is_recording(path))


def _content(path: Path, rig: Rig | None, sampling: dict | None, fit_linear: str | None) -> FolderContent:
    if not os.path.exists(path / INDEX):
        if not is_free(path):
            return FolderContent(FolderState.FOREIGN, sentence=f"'{path.name}' is not an empty folder; choose another.")
        return FolderContent(FolderState.FREE)
    try:
        index = read_index(path)
    except RecordingError as error:
        return FolderContent(FolderState.FOREIGN, sentence=str(error))
    counts = index["complete"], index["poses"]
    if rig is not None and (found := _differences(index, rig)):
        return FolderContent(
            FolderState.OTHER,
            *counts,
            f"'{path.name}' holds a recording of another rig: {'; '.join(found)}. Choose another folder, or remove it.",
        )
    found = different_keys(_as_recorded_first(index["sampling"]), sampling) if sampling is not None else []
    info = read_info(index)
    fit = info.fit
    if fit_linear is not None and fit_linear != (fit.kind if fit else ""):
        found.append("fit")
    names = ", ".join(sorted({SETTINGS.get(key.partition(".")[0], key) for key in found}))
    if counts[0] == counts[1]:
        sentence = f"It was recorded with other settings than those above: {names}." if found else ""
        measured = tuple(part.sentence() for part in (fit, info.repeatability) if part)
        return FolderContent(FolderState.COMPLETE, *counts, sentence, measured)
    if found:
        return FolderContent(
            FolderState.OTHER,
            *counts,
            f"'{path.name}' was begun with other settings ({names}) and has {counts[0]} of {counts[1]} poses. Set them "
            "as they were to resume, choose another folder, or remove it.",
        )
    return FolderContent(FolderState.INCOMPLETE, *counts)


def recordings_in(folder: Path) -> list[Path]:
    """The recordings that lie in a folder, each in a folder of its own; none where the folder is a recording itself."""
    if os.path.exists(folder / INDEX) or not os.path.isdir(folder):
        return []
    return sorted(path for path in folder.iterdir() if os.path.isfile(path / INDEX))


def _as_recorded_first(sampling: dict) -> dict:
    """A sampling without the poses that were added where a model was worst."""
    return {**sampling, "sources": [source for source in sampling["sources"] if source["kind"] != REFINED]}


def _differences(index: dict, rig: Rig) -> list[str]:
    joints = read_joints(index["joints"])
    fingerprint = Fingerprint.from_json(index["rig"]["fingerprint"])
    # The rest pose of the joints is in an array; what differs there is found when the recording is used.
    return rig_differences(joints, rig.rest_matrices, index["vertices"], fingerprint, rig)


def remove_recording(path: Path) -> None:
    """Remove the files of a recording, and its folder when nothing else is in it.

    Raises:
        RecordingError: there is no recording, or another process writes it.
        OutputError: a file cannot be removed.
    """
    if not os.path.exists(path / INDEX):
        raise RecordingError(f"'{path}' holds no recording; there is nothing to remove.")
    lock = RecordingLock(path)
    try:
        lock.acquire()
        remove_files(path)
        lock.release()
        # It stays where something is in it, or another program has it open.
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
