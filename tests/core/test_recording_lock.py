# SPDX-License-Identifier: GPL-3.0-or-later
"""Two processes and one recording: the second is told, and a lock that nobody holds any more stops nobody."""

import json
import os
import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from limb import make_rig, partitions_of, record_limb, recording_info

from fdda_addon.core.errors import RecordingError
from fdda_addon.core.recording import read_index, read_recording
from fdda_addon.core.recording_extension import RecordingExtension
from fdda_addon.core.recording_lock import LOCK, RecordingLock
from fdda_addon.core.recording_writer import RecordingWriter

ROOT = Path(__file__).resolve().parents[2]
OTHER_PROCESS = """
import sys
from pathlib import Path
from fdda_addon.core.recording_lock import RecordingLock
RecordingLock(Path(sys.argv[1])).acquire()
print("locked", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def other(tmp_path: Path):
    """Another process that holds the lock of tmp_path, and never gives it back."""
    command = [sys.executable, "-c", OTHER_PROCESS, str(tmp_path)]
    process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "locked\n"
    yield process
    process.kill()
    process.communicate()


def write(path: Path, **options) -> RecordingWriter:
    rig = make_rig()
    return RecordingWriter(path, rig, partitions_of(rig), recording_info(4), **options)


def test_the_second_process_is_told_and_changes_nothing(other, tmp_path):
    with pytest.raises(RecordingError, match=rf"Another Blender \(process {other.pid}\) is recording into"):
        write(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [LOCK]


def test_the_lock_of_a_process_that_is_gone_is_taken_over(other, tmp_path):
    other.kill()
    other.wait()
    with write(tmp_path):
        assert json.loads((tmp_path / LOCK).read_text())["pid"] == os.getpid()
    assert LOCK not in [path.name for path in tmp_path.iterdir()]


def test_a_lock_of_another_machine_is_believed_and_can_be_removed(tmp_path):
    (tmp_path / LOCK).write_text(json.dumps({"pid": 1, "host": "render-07"}))
    with pytest.raises(RecordingError, match=re.escape("(process 1 on 'render-07')")) as error:
        write(tmp_path)
    assert str(error.value).endswith(f"remove '{LOCK}' there.")
    (tmp_path / LOCK).unlink()
    with write(tmp_path):
        pass


def test_a_lock_of_the_same_number_in_an_earlier_life_is_taken_over(tmp_path):
    """Containers start with the same process numbers again."""
    (tmp_path / LOCK).write_text(json.dumps({"pid": os.getpid(), "host": socket.gethostname()}))
    with write(tmp_path):
        pass


@pytest.mark.parametrize("text", ["", "{", "[]", '{"pid": "x", "host": 1}', '{"pid": -5, "host": "HOST"}'])
def test_a_damaged_lock_holds_for_a_moment_only(tmp_path, text):
    (tmp_path / LOCK).write_text(text.replace("HOST", socket.gethostname()))
    if "-5" not in text:
        with pytest.raises(RecordingError, match="Another process is recording"):
            write(tmp_path)
    os.utime(tmp_path / LOCK, (0, 0))
    with write(tmp_path):
        pass


def test_one_process_does_not_write_a_recording_twice(tmp_path):
    with write(tmp_path / "r"):
        before = sorted(path.name for path in (tmp_path / "r").iterdir())
        with pytest.raises(RecordingError, match="This Blender is recording into"):
            write(tmp_path / "r", resume=True)
        assert sorted(path.name for path in (tmp_path / "r").iterdir()) == before
    assert read_index(tmp_path / "r")["complete"] == 0


def test_an_extension_locks_too(tmp_path):
    record_limb(tmp_path / "r", 4)
    with (
        RecordingExtension(read_recording(tmp_path / "r"), "m.onnx"),
        pytest.raises(RecordingError, match="This Blender is recording into"),
    ):
        write(tmp_path / "r", resume=True)
    assert not (tmp_path / "r" / LOCK).exists()


def test_a_lock_that_is_not_held_is_not_released(tmp_path):
    (tmp_path / LOCK).write_text("somebody's")
    lock = RecordingLock(tmp_path)
    lock.release()
    assert not lock.is_held and (tmp_path / LOCK).exists()
