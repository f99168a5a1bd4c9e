# SPDX-License-Identifier: GPL-3.0-or-later
"""What is said of a folder before anything is recorded into it, and what removing a recording removes."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from limb import JOINTS, make_rig, record_limb, recording_info

from fdda_addon.core.errors import OutputError, RecordingError
from fdda_addon.core.recording_folder import FolderContent, FolderState, read_folder, remove_recording
from fdda_addon.core.recording_lock import LOCK

POSES = 12
SAMPLING = json.loads(json.dumps(recording_info(POSES).sampling.to_json()))


def look(path: Path, **changes: object) -> FolderContent:
    """What a folder holds for the limb, with changes to the sampling that is wanted."""
    return read_folder(path, make_rig(), SAMPLING | changes)


def test_a_folder_that_is_not_there_or_empty_is_free(tmp_path):
    assert look(tmp_path / "none").state is look(tmp_path).state is FolderState.FREE
    (tmp_path / LOCK).write_text("{}")
    assert look(tmp_path).state is FolderState.FREE


def test_something_else_is_in_it(tmp_path):
    (tmp_path / "letters.txt").write_text("dear")
    content = look(tmp_path)
    assert (content.state, content.poses) == (FolderState.FOREIGN, 0)
    assert content.sentence == f"'{tmp_path.name}' is not an empty folder; choose another."
    assert look(tmp_path / "letters.txt").state is FolderState.FOREIGN


def test_a_recording_that_is_complete(tmp_path):
    record_limb(tmp_path / "r", POSES)
    assert look(tmp_path / "r") == FolderContent(FolderState.COMPLETE, POSES, POSES)
    other = look(tmp_path / "r", limits=[], spread=0.5)
    assert other.state is FolderState.COMPLETE
    assert other.sentence == "It was recorded with other settings than those above: range of motion, spread."


def test_a_recording_that_was_broken_off(tmp_path):
    record_limb(tmp_path / "r", POSES, 5)
    assert look(tmp_path / "r") == FolderContent(FolderState.INCOMPLETE, 5, POSES)
    other = look(tmp_path / "r", seed=9)
    assert other.state is FolderState.OTHER
    assert other.sentence.startswith("'r' was begun with other settings (seed) and has 5 of 12 poses.")


@pytest.mark.parametrize("complete", [5, POSES])
def test_a_recording_of_another_rig(tmp_path, complete):
    record_limb(tmp_path / "r", POSES, complete)
    renamed = replace(make_rig(), joints=(replace(JOINTS[0], name="tail"), *JOINTS[1:]))
    content = read_folder(tmp_path / "r", renamed, SAMPLING)
    assert (content.state, content.complete) == (FolderState.OTHER, complete)
    assert f"the armature lacks the joint '{JOINTS[0].name}'; it does not know the joint 'tail'" in content.sentence
    assert read_folder(tmp_path / "r").state is not FolderState.OTHER, "without a rig nothing is compared"


def test_a_recording_that_is_damaged(tmp_path):
    record_limb(tmp_path / "r", POSES)
    (tmp_path / "r" / "recording.json").write_text("{")
    content = look(tmp_path / "r")
    assert content.state is FolderState.FOREIGN and "cannot be read" in content.sentence


def test_removing_leaves_nothing_of_it_and_all_else(tmp_path):
    for name in ("r", "with_notes"):
        record_limb(tmp_path / name, POSES)
    (tmp_path / "with_notes" / "notes.txt").write_text("mine")
    for name in ("r", "with_notes"):
        remove_recording(tmp_path / name)
    assert [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")] == ["with_notes", "with_notes/notes.txt"]


def test_nothing_to_remove(tmp_path):
    (tmp_path / "residuals.npy").write_text("of someone else")
    with pytest.raises(RecordingError, match="holds no recording; there is nothing to remove"):
        remove_recording(tmp_path)
    assert (tmp_path / "residuals.npy").exists()


def test_a_recording_that_is_being_written_is_not_removed(tmp_path):
    record_limb(tmp_path / "r", POSES)
    (tmp_path / "r" / LOCK).write_text(json.dumps({"pid": 1, "host": "elsewhere"}))
    with pytest.raises(RecordingError, match="is recording into"):
        remove_recording(tmp_path / "r")
    assert look(tmp_path / "r").state is FolderState.COMPLETE


def test_what_cannot_be_removed_is_said(tmp_path):
    record_limb(tmp_path / "r", POSES)
    (tmp_path / "r" / "residuals.npy").unlink()
    (tmp_path / "r" / "residuals.npy").mkdir()
    with pytest.raises(OutputError, match="Cannot remove the recording"):
        remove_recording(tmp_path / "r")
    assert not (tmp_path / "r" / LOCK).exists()
