# SPDX-License-Identifier: GPL-3.0-or-later
"""The state of a folder before anything is recorded into it, its lock, and which files removing a recording removes."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from fdda_addon.core.errors import BusyError, OutputError, RecordingError
from fdda_addon.core.recording.arrays import ARRAY_NAMES
from fdda_addon.core.recording.folder import FolderContent, FolderState, read_folder, remove_recording
from fdda_addon.core.recording.lock import LOCK_NAME, RecordingLock
from fdda_addon.core.recording.writer import RecordingWriter

from .. import systems
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


ROOT = Path(__file__).resolve().parents[2]

HOLD_LOCK = """
import sys
from pathlib import Path
from fdda_addon.core.recording.lock import RecordingLock
lock = RecordingLock(Path(sys.argv[1]))
lock.acquire()
print("locked", flush=True)
sys.stdin.read()
"""

ACQUIRE_REPEATEDLY = """
import os, sys, time
from pathlib import Path
from fdda_addon.core.errors import RecordingError
from fdda_addon.core.recording.lock import RecordingLock
folder, marker_path = Path(sys.argv[1]), sys.argv[1] + "/held"
end_time, acquired_count = time.monotonic() + 2, 0
while time.monotonic() < end_time:
    child = os.fork()
    if not child:
        # The child acquires the lock of an ended process and ends without releasing it.
        try:
            lock = RecordingLock(folder)
            lock.acquire()
            os.close(os.open(marker_path, os.O_CREAT | os.O_EXCL))
            time.sleep(0.001)
            os.unlink(marker_path)
            os._exit(0)
        except RecordingError:
            os._exit(1)
        except FileExistsError:
            os._exit(2)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if status == 2:
        sys.exit("Two processes held the lock.")
    acquired_count += status == 0
print(acquired_count)
"""


@pytest.fixture
def lock_process(tmp_path: Path):
    """Start another process that holds the lock of tmp_path until it is killed."""
    command = [sys.executable, "-c", HOLD_LOCK, str(tmp_path)]
    process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "locked\n"
    yield process
    process.kill()
    process.communicate()


def make_writer(path: Path, **options) -> RecordingWriter:
    """Return a writer of a recording of the limb, which acquires its lock."""
    rig = make_rig()
    return RecordingWriter(path, rig, recording_info(4), **options)


def test_a_second_process_is_refused_until_the_first_has_ended(lock_process, tmp_path):
    with pytest.raises(BusyError, match="Another job is recording into") as error:
        make_writer(tmp_path)
    assert str(error.value).endswith("wait for it, or choose another folder.")
    assert [path.name for path in tmp_path.iterdir()] == [LOCK_NAME]
    lock_process.kill()
    lock_process.wait()
    assert (tmp_path / LOCK_NAME).exists()
    with make_writer(tmp_path):
        names_before = sorted(path.name for path in tmp_path.iterdir())
        with pytest.raises(BusyError, match="Another job is recording into"):
            make_writer(tmp_path, resume=True)
        assert LOCK_NAME in names_before == sorted(path.name for path in tmp_path.iterdir())
    assert not (tmp_path / LOCK_NAME).exists()


@systems.forks
def test_one_of_several_processes_acquires_a_stale_lock(tmp_path):
    (tmp_path / LOCK_NAME).touch()
    command = [sys.executable, "-c", ACQUIRE_REPEATEDLY, str(tmp_path)]
    processes = [
        subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) for _ in range(4)
    ]
    outputs = [process.communicate() for process in processes]
    assert [process.returncode for process in processes] == [0] * 4, outputs
    assert sum(int(stdout) for stdout, _ in outputs) > 20


def test_the_lock_file_is_the_lock_on_a_drive_that_cannot_lock_files(tmp_path, monkeypatch):
    systems.refuse_locks(monkeypatch)
    path = tmp_path / "r" / LOCK_NAME
    with make_writer(tmp_path / "r") as writer:
        assert writer.note.startswith(f"The drive of '{tmp_path / 'r'}' cannot lock files; ") and path.exists()
        with pytest.raises(BusyError, match="Another job is recording into") as error:
            make_writer(tmp_path / "r", resume=True)
    assert f"remove '{LOCK_NAME}' there if it has ended: the drive cannot lock files." in str(error.value)
    with make_writer(tmp_path / "r", resume=True):
        pass
    assert not path.exists()


@systems.symbolic_links
def test_a_link_in_place_of_the_lock_file_is_not_followed(tmp_path):
    victim = tmp_path / "victim"
    victim.write_text("precious")
    (tmp_path / "r").mkdir()
    (tmp_path / "r" / LOCK_NAME).symlink_to(victim)
    with pytest.raises(OutputError, match="Cannot write the recording"):
        make_writer(tmp_path / "r")
    assert victim.read_text() == "precious" and victim.exists()


@systems.named_pipes
def test_a_pipe_in_place_of_the_lock_file_is_refused(tmp_path):
    os.mkfifo(tmp_path / LOCK_NAME)
    with pytest.raises(OutputError, match=rf"'{LOCK_NAME}' is not a regular file"):
        make_writer(tmp_path)
