# SPDX-License-Identifier: GPL-3.0-or-later
"""Two processes with one recording: the second one is refused; a lock whose process has ended is ignored."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fdda_addon.core.errors import BusyError, OutputError
from fdda_addon.core.recording.lock import LOCK_NAME
from fdda_addon.core.recording.writer import RecordingWriter

from .. import systems
from .limb import make_rig, recording_info

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
