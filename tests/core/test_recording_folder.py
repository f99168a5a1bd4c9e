# SPDX-License-Identifier: GPL-3.0-or-later
"""The state of a folder before anything is recorded into it, and which files removing a recording removes."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from fdda_addon.core.errors import OutputError, RecordingError
from fdda_addon.core.recording.arrays import ARRAY_NAMES
from fdda_addon.core.recording.folder import FolderContent, FolderState, read_folder, remove_recording
from fdda_addon.core.recording.lock import LOCK_NAME, RecordingLock
from fdda_addon.core.recording.writer import RecordingWriter

from .good_recording import good_recording
from .limb import JOINTS, make_rig, record_limb, recording_info

POSE_COUNT = 12
SAMPLING = json.loads(json.dumps(recording_info(POSE_COUNT).sampling.to_json()))


def read_limb_folder(path: Path, **changes: object) -> FolderContent:
    """Return the content of a folder, compared with the limb and `SAMPLING` with changed keys."""
    return read_folder(path, make_rig(), SAMPLING | changes)


def test_a_missing_or_empty_folder_is_free(tmp_path):
    assert read_limb_folder(tmp_path / "none").state is read_limb_folder(tmp_path).state is FolderState.FREE
    (tmp_path / LOCK_NAME).write_text("{}")
    assert read_limb_folder(tmp_path).state is FolderState.FREE


def test_a_folder_with_other_files_is_foreign(tmp_path):
    (tmp_path / "letters.txt").write_text("dear")
    content = read_limb_folder(tmp_path)
    assert (content.state, content.poses) == (FolderState.FOREIGN, 0)
    assert content.sentence == f"'{tmp_path.name}' is not an empty folder; choose another."
    assert not content.is_recording
    assert read_limb_folder(tmp_path / "letters.txt").state is FolderState.FOREIGN


def test_state_of_a_complete_recording(tmp_path):
    record_limb(tmp_path / "r", POSE_COUNT)
    assert read_limb_folder(tmp_path / "r") == FolderContent(
        FolderState.COMPLETE, POSE_COUNT, POSE_COUNT, is_recording=True
    )
    content = read_limb_folder(tmp_path / "r", limits=[], spread=0.5)
    assert content.state is FolderState.COMPLETE
    assert content.sentence == "It was recorded with other settings than those above: range of motion, spread."


def test_state_of_an_interrupted_recording(tmp_path):
    record_limb(tmp_path / "r", POSE_COUNT, 5)
    assert read_limb_folder(tmp_path / "r") == FolderContent(FolderState.INCOMPLETE, 5, POSE_COUNT, is_recording=True)
    content = read_limb_folder(tmp_path / "r", seed=9)
    assert content.state is FolderState.OTHER
    assert content.sentence.startswith("'r' was begun with other settings (seed) and has 5 of 12 poses.")


@pytest.mark.parametrize("complete", [5, POSE_COUNT])
def test_state_of_a_recording_of_another_rig(tmp_path, complete):
    record_limb(tmp_path / "r", POSE_COUNT, complete)
    renamed_rig = replace(make_rig(), joints=(replace(JOINTS[0], name="tail"), *JOINTS[1:]))
    content = read_folder(tmp_path / "r", renamed_rig, SAMPLING)
    assert (content.state, content.complete) == (FolderState.OTHER, complete)
    assert f"the armature lacks the joint '{JOINTS[0].name}'; it does not know the joint 'tail'" in content.sentence
    assert read_folder(tmp_path / "r").state is not FolderState.OTHER, "without a rig nothing is compared"


def test_state_of_a_damaged_recording(tmp_path):
    record_limb(tmp_path / "r", POSE_COUNT)
    (tmp_path / "r" / "recording.json").write_text("{")
    content = read_limb_folder(tmp_path / "r")
    assert content.state is FolderState.FOREIGN and "cannot be read" in content.sentence
    assert content.is_recording and content.sentence.endswith("record again with --overwrite.")
    (tmp_path / "r" / "positions.npy").unlink()
    assert not read_limb_folder(tmp_path / "r").is_recording, "a '{' and some file may be anything"


def test_removing_deletes_the_recording_and_keeps_other_files(tmp_path):
    for name in ("r", "with_notes"):
        record_limb(tmp_path / name, POSE_COUNT)
    (tmp_path / "with_notes" / "notes.txt").write_text("mine")
    for name in ("r", "with_notes"):
        remove_recording(tmp_path / name)
    assert [path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*")] == [
        "with_notes",
        "with_notes/notes.txt",
    ]


def test_every_array_is_removed(tmp_path):
    """The array of controls is removed too; otherwise the folder would not be empty for the next recording."""
    path, recording = tmp_path / "r", good_recording(4)
    info = replace(recording.info, complete=0)
    with RecordingWriter(path, recording.rig, info) as writer:
        writer.append(recording.pose_matrices, recording.residuals, recording.controls)
    assert (path / "controls.npy").exists()
    assert {file.stem for file in path.glob("*.npy")} <= set(ARRAY_NAMES)
    (path / f".fdda-{'0' * 12}.json").touch()
    remove_recording(path)
    assert not path.exists()


LEFTOVER_NAMES = ("recording.lock", f".fdda-{'a1' * 6}.json")


def test_leftovers_of_a_killed_first_write_are_ignored(tmp_path):
    """A process that is killed while it first writes the index leaves a temporary file and no index."""
    for name in LEFTOVER_NAMES:
        (tmp_path / name).write_text("{")
    assert read_limb_folder(tmp_path).state is FolderState.FREE
    record_limb(tmp_path, POSE_COUNT)
    assert not {path.name for path in tmp_path.iterdir()} & set(LEFTOVER_NAMES)
    (tmp_path / LEFTOVER_NAMES[1]).write_text("{")
    assert read_limb_folder(tmp_path).state is FolderState.COMPLETE


def test_removing_from_a_folder_without_a_recording_is_refused(tmp_path):
    (tmp_path / "positions.npy").write_text("of someone else")
    with pytest.raises(RecordingError, match="holds no recording; there is nothing to remove"):
        remove_recording(tmp_path)
    assert (tmp_path / "positions.npy").exists()


def test_a_recording_that_is_being_written_is_not_removed(tmp_path):
    record_limb(tmp_path / "r", POSE_COUNT)
    lock = RecordingLock(tmp_path / "r")
    lock.acquire()
    with pytest.raises(RecordingError, match="is recording into"):
        remove_recording(tmp_path / "r")
    lock.release()
    assert read_limb_folder(tmp_path / "r").state is FolderState.COMPLETE


def test_a_folder_that_cannot_be_removed_is_named(tmp_path):
    record_limb(tmp_path / "r", POSE_COUNT)
    (tmp_path / "r" / "positions.npy").unlink()
    (tmp_path / "r" / "positions.npy").mkdir()
    with pytest.raises(OutputError, match="Cannot remove the recording"):
        remove_recording(tmp_path / "r")
    assert not (tmp_path / "r" / LOCK_NAME).exists()
