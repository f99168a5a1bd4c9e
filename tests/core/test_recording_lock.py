# SPDX-License-Identifier: GPL-3.0-or-later
"""Two processes and one recording: the second is told, and a lock that nobody holds any more stops nobody."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from fdda_addon.core.errors import OutputError, RecordingError
from fdda_addon.core.recording.extension import RecordingExtension
from fdda_addon.core.recording.index import read_index
from fdda_addon.core.recording.lock import LOCK_NAME, RecordingLock
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.writer import RecordingWriter

from .. import systems
from .limb import make_rig, partitions_of, record_limb, recording_info

ROOT = Path(__file__).resolve().parents[2]
OTHER_PROCESS = """
import os, sys
from pathlib import Path
from fdda_addon.core.recording.lock import RecordingLock
lock = RecordingLock(Path(sys.argv[1]))
lock.acquire()
print(os.getpid(), flush=True)
sys.stdin.read()
"""
TAKERS = """
import os, sys, time
from pathlib import Path
from fdda_addon.core.errors import RecordingError
from fdda_addon.core.recording.lock import RecordingLock
folder, marker = Path(sys.argv[1]), sys.argv[1] + "/held"
end, won = time.monotonic() + 2, 0
while time.monotonic() < end:
    child = os.fork()
    if not child:
        # Takes the lock of one that is gone, and is gone without giving it back.
        try:
            lock = RecordingLock(folder)
            lock.acquire()
            os.close(os.open(marker, os.O_CREAT | os.O_EXCL))
            time.sleep(0.001)
            os.unlink(marker)
            os._exit(0)
        except RecordingError:
            os._exit(1)
        except FileExistsError:
            os._exit(2)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if status == 2:
        sys.exit("two had it")
    won += status == 0
print(won)
"""


@pytest.fixture
def other(tmp_path: Path):
    """Another process that holds the lock of tmp_path, and never gives it back."""
    command = [sys.executable, "-c", OTHER_PROCESS, str(tmp_path)]
    process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    # Not process.pid: the Python of a virtual environment on Windows starts another one.
    process.owner = int(process.stdout.readline())
    yield process
    process.kill()
    process.communicate()


def write(path: Path, **options) -> RecordingWriter:
    rig = make_rig()
    return RecordingWriter(path, rig, partitions_of(rig), recording_info(4), **options)


def test_the_second_process_is_told_and_changes_nothing(other, tmp_path):
    with pytest.raises(RecordingError, match=rf"Another Blender \(process {other.owner}\) is recording into") as error:
        write(tmp_path)
    assert str(error.value).endswith("wait for it, or choose another folder.")
    assert [path.name for path in tmp_path.iterdir()] == [LOCK_NAME]


def test_the_lock_of_a_process_that_is_gone_is_taken_over(other, tmp_path):
    other.kill()
    other.wait()
    assert (tmp_path / LOCK_NAME).exists()
    with write(tmp_path):
        assert json.loads((tmp_path / LOCK_NAME).read_text())["pid"] == os.getpid()
    assert LOCK_NAME not in [path.name for path in tmp_path.iterdir()]


@systems.forks
def test_of_several_takers_of_a_dead_lock_one_gets_it(tmp_path):
    (tmp_path / LOCK_NAME).write_text("{}")
    command = [sys.executable, "-c", TAKERS, str(tmp_path)]
    takers = [
        subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) for _ in range(4)
    ]
    answers = [taker.communicate() for taker in takers]
    assert [taker.returncode for taker in takers] == [0] * 4, answers
    assert sum(int(out) for out, _ in answers) > 20


OTHERS_LOCKS = {
    "of another machine": json.dumps({"pid": 1, "host": "render-07"}),
    "of the same number": json.dumps({"pid": os.getpid(), "host": socket.gethostname()}),
    "empty, from a full disk": "",
    "damaged": '{"pid": "x", "host": 1}',
}


@pytest.mark.parametrize("text", OTHERS_LOCKS.values(), ids=OTHERS_LOCKS)
def test_what_a_file_says_that_nobody_has_locked_stops_nobody(tmp_path, text):
    """Numbers of processes mean nothing in another container, or after a restart."""
    (tmp_path / LOCK_NAME).write_text(text)
    with write(tmp_path):
        pass


@pytest.mark.parametrize("text", ["", "{", "[]", '{"pid": "x", "host": 1}', "x" * 5000, "[" * 900])
def test_a_lock_that_names_nobody_holds_all_the_same(other, tmp_path, text):
    (tmp_path / LOCK_NAME).write_text(text)
    with pytest.raises(RecordingError, match=r"^Another process is recording into"):
        write(tmp_path)


def test_a_lock_on_a_full_disk_holds(small_disk):
    (small_disk / "ballast").write_bytes(b"x" * os.statvfs(small_disk).f_bavail * 4096)
    lock = RecordingLock(small_disk)
    lock.acquire()
    with pytest.raises(RecordingError, match="This Blender is recording into"):
        RecordingLock(small_disk).acquire()
    lock.release()
    assert not (small_disk / LOCK_NAME).exists()


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
    assert not (tmp_path / "r" / LOCK_NAME).exists()


def test_a_lock_that_is_not_held_is_not_released(tmp_path):
    (tmp_path / LOCK_NAME).write_text("somebody's")
    lock = RecordingLock(tmp_path)
    lock.release()
    assert not lock.is_held and (tmp_path / LOCK_NAME).exists()


@systems.symbolic_links
def test_a_link_in_place_of_the_lock_is_not_followed(tmp_path):
    victim = tmp_path / "victim"
    victim.write_text("precious")
    (tmp_path / "r").mkdir()
    (tmp_path / "r" / LOCK_NAME).symlink_to(victim)
    with pytest.raises(OutputError, match="Cannot write the recording"):
        write(tmp_path / "r")
    assert victim.read_text() == "precious" and victim.exists()


@systems.named_pipes
def test_a_pipe_in_place_of_the_lock_blocks_nobody(tmp_path):
    os.mkfifo(tmp_path / LOCK_NAME)
    with pytest.raises(OutputError, match=rf"'{LOCK_NAME}' is not a regular file"):
        write(tmp_path)
