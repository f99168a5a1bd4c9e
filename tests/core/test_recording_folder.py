# SPDX-License-Identifier: GPL-3.0-or-later
"""What is said of a folder before anything is recorded into it, and what removing a recording removes."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from fdda_addon.core.errors import OutputError, RecordingError
from fdda_addon.core.recording.arrays import ARRAY_NAMES
from fdda_addon.core.recording.folder import FolderContent, FolderState, read_folder, remove_recording
from fdda_addon.core.recording.lock import LOCK_NAME, RecordingLock
from fdda_addon.core.recording.target import STATISTIC_NAMES, Repeatability
from fdda_addon.core.recording.writer import RecordingWriter

from .good_recording import good_recording
from .limb import JOINTS, make_rig, record_limb, recording_info

POSES = 12
SAMPLING = json.loads(json.dumps(recording_info(POSES).sampling.to_json()))


def look(path: Path, **changes: object) -> FolderContent:
    """What a folder holds for the limb, with changes to the sampling that is wanted."""
    return read_folder(path, make_rig(), SAMPLING | changes)


def test_a_folder_that_is_not_there_or_empty_is_free(tmp_path):
    assert look(tmp_path / "none").state is look(tmp_path).state is FolderState.FREE
    (tmp_path / LOCK_NAME).write_text("{}")
    assert look(tmp_path).state is FolderState.FREE


def test_something_else_is_in_it(tmp_path):
    (tmp_path / "letters.txt").write_text("dear")
    content = look(tmp_path)
    assert (content.state, content.poses) == (FolderState.FOREIGN, 0)
    assert content.sentence == f"'{tmp_path.name}' is not an empty folder; choose another."
    assert not content.is_recording
    assert look(tmp_path / "letters.txt").state is FolderState.FOREIGN


def test_a_recording_that_is_complete(tmp_path):
    record_limb(tmp_path / "r", POSES)
    assert look(tmp_path / "r") == FolderContent(FolderState.COMPLETE, POSES, POSES, is_recording=True)
    other = look(tmp_path / "r", limits=[], spread=0.5)
    assert other.state is FolderState.COMPLETE
    assert other.sentence == "It was recorded with other settings than those above: range of motion, spread."


def test_what_was_measured_with_a_recording_is_said(tmp_path):
    record_limb(tmp_path / "r", POSES)
    repeatability = Repeatability((1, 2), dict.fromkeys(STATISTIC_NAMES, 0.25), 5.0)
    index = json.loads((tmp_path / "r" / "recording.json").read_text())
    (tmp_path / "r" / "recording.json").write_text(json.dumps({**index, "repeatability": repeatability.to_json()}))
    assert look(tmp_path / "r").measured_sentences == (repeatability.sentence(),)
    assert "0.25 mm apart on average" in repeatability.sentence()


def test_a_recording_that_was_broken_off(tmp_path):
    record_limb(tmp_path / "r", POSES, 5)
    assert look(tmp_path / "r") == FolderContent(FolderState.INCOMPLETE, 5, POSES, is_recording=True)
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
    assert content.is_recording and content.sentence.endswith("record again with --overwrite.")
    (tmp_path / "r" / "residuals.npy").unlink()
    assert not look(tmp_path / "r").is_recording, "a '{' and some file may be anything"


def test_removing_leaves_nothing_of_it_and_all_else(tmp_path):
    for name in ("r", "with_notes"):
        record_limb(tmp_path / name, POSES)
    (tmp_path / "with_notes" / "notes.txt").write_text("mine")
    for name in ("r", "with_notes"):
        remove_recording(tmp_path / name)
    assert [path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*")] == [
        "with_notes",
        "with_notes/notes.txt",
    ]


def test_every_array_is_removed(tmp_path):
    """Of a rig with controls too: what is left would refuse the next recording."""
    path, recording = tmp_path / "r", good_recording(4)
    info = replace(recording.info, complete=0)
    with RecordingWriter(path, recording.rig, recording.partitions, info) as writer:
        writer.append(recording.pose_matrices, recording.residuals, recording.controls)
    assert (path / "controls.npy").exists()
    assert {file.stem for file in path.glob("*.npy")} <= set(ARRAY_NAMES)
    (path / f".fdda-{'0' * 12}.json").touch()
    remove_recording(path)
    assert not path.exists()


LEFT_OVER = ("recording.lock", f".fdda-{'a1' * 6}.json")


def test_what_a_first_write_left_that_was_killed_stops_nobody(tmp_path):
    """A process that is killed while it writes the index for the first time leaves a file and no index."""
    for name in LEFT_OVER:
        (tmp_path / name).write_text("{")
    assert look(tmp_path).state is FolderState.FREE
    record_limb(tmp_path, POSES)
    assert not {path.name for path in tmp_path.iterdir()} & set(LEFT_OVER)
    (tmp_path / LEFT_OVER[1]).write_text("{")
    assert look(tmp_path).state is FolderState.COMPLETE


def test_nothing_to_remove(tmp_path):
    (tmp_path / "residuals.npy").write_text("of someone else")
    with pytest.raises(RecordingError, match="holds no recording; there is nothing to remove"):
        remove_recording(tmp_path)
    assert (tmp_path / "residuals.npy").exists()


def test_a_recording_that_is_being_written_is_not_removed(tmp_path):
    record_limb(tmp_path / "r", POSES)
    lock = RecordingLock(tmp_path / "r")
    lock.acquire()
    with pytest.raises(RecordingError, match="is recording into"):
        remove_recording(tmp_path / "r")
    lock.release()
    assert look(tmp_path / "r").state is FolderState.COMPLETE


def test_a_folder_that_cannot_be_removed_is_named(tmp_path):
    record_limb(tmp_path / "r", POSES)
    (tmp_path / "r" / "residuals.npy").unlink()
    (tmp_path / "r" / "residuals.npy").mkdir()
    with pytest.raises(OutputError, match="Cannot remove the recording"):
        remove_recording(tmp_path / "r")
    assert not (tmp_path / "r" / LOCK_NAME).exists()
