# SPDX-License-Identifier: GPL-3.0-or-later
"""Files that another program has open: waited for, and nothing is lost where waiting does not help."""

import errno
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from fdda_addon.core import open_files
from fdda_addon.core.errors import TRY_AGAIN, OutputError, exit_status
from fdda_addon.core.output import atomic_write_all, write_text
from fdda_addon.core.recording.folder import remove_recording
from fdda_addon.core.recording.folder_check import check_recordable
from fdda_addon.core.recording.index import read_index
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.writer import RecordingWriter

from .limb import make_rig, partitions_of, random_poses, random_residuals, record_limb, recording_info

on_windows = pytest.mark.skipif(sys.platform != "win32", reason="elsewhere a file that is open can be replaced")
READER = """
import sys, time
from pathlib import Path
files = [Path(name) for name in sys.argv[2:]]
print("reads", flush=True)
while True:
    for path in files:
        try:
            with open(path, "rb") as file:
                file.read()
                time.sleep(float(sys.argv[1]))
        except OSError:
            pass
    time.sleep(0.05)
"""


@pytest.fixture
def read():
    """Start processes that open files again and again, for so many seconds each time."""
    processes = []

    def start(seconds: float, *paths: Path) -> subprocess.Popen:
        command = [sys.executable, "-c", READER, str(seconds), *map(str, paths)]
        processes.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
        assert processes[-1].stdout.readline() == "reads\n"
        return processes[-1]

    yield start
    for process in processes:
        process.kill()
        process.communicate()


@pytest.fixture
def refused(monkeypatch):
    """Refuse to rename to a path as Windows does, so many times; gives the function that says which and how often."""
    left: dict[str, int] = {}
    rename = os.replace

    def replace(source: Path, target: Path) -> None:
        if left.get(os.path.basename(target), 0) > 0:
            left[os.path.basename(target)] -= 1
            error = PermissionError(errno.EACCES, "Zugriff verweigert", str(source), None, str(target))
            error.winerror = 5
            raise error
        rename(source, target)

    monkeypatch.setattr(os, "replace", replace)
    monkeypatch.setattr(open_files, "RETRY_SECONDS", 0.3)
    monkeypatch.setattr(open_files, "MAX_PAUSE_SECONDS", 0.01)
    return left.update


def contents(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in sorted(folder.iterdir())}


def test_what_is_open_for_a_moment_is_waited_for(tmp_path, refused, monkeypatch):
    monkeypatch.setattr(open_files, "RETRY_SECONDS", 30)
    write_text(tmp_path / "a", "old")
    refused({"a": 5})
    write_text(tmp_path / "a", "new")
    assert contents(tmp_path) == {"a": "new"}


@pytest.mark.parametrize("number", range(3))
def test_what_stays_open_is_not_replaced_and_what_was_made_is_kept(tmp_path, refused, number):
    paths = [tmp_path / name for name in ("a", "b", "c")]
    for path in paths[:2]:
        path.write_text("old")
    refused({paths[number].name: 10**9})
    with pytest.raises(OutputError) as failed, atomic_write_all(*paths) as temporaries:
        for temporary in temporaries:
            temporary.write_text("new")
    assert str(failed.value) == (
        f"Cannot write '{paths[number]}': another program has it open; nothing was changed, and what was made is kept "
        f"as 'new-a', 'new-b', 'new-c'; close what has '{paths[number].name}' open, and rename them."
    )
    assert exit_status(failed.value) == TRY_AGAIN
    assert contents(tmp_path) == {"a": "old", "b": "old", "new-a": "new", "new-b": "new", "new-c": "new"}


def test_a_recording_whose_index_stays_open_resumes(tmp_path, refused):
    rig, matrices, residuals = make_rig(), random_poses(12), random_residuals(12)
    with (
        pytest.raises(OutputError, match=r"another program has it open; 4 of 12 poses are complete, continue with"),
        RecordingWriter(tmp_path / "r", rig, partitions_of(rig), recording_info(12)) as writer,
    ):
        writer.append(matrices[:4], residuals[:4])
        refused({"recording.json": 10**9})
        writer.append(matrices[4:8], residuals[4:8])
    refused({"recording.json": 0})
    assert read_index(tmp_path / "r")["complete"] == 4
    assert [path.name for path in (tmp_path / "r").glob("*.json")] == ["recording.json"]
    record_limb(tmp_path / "r", 12, resume=True)
    assert np.array_equal(read_recording(tmp_path / "r").residuals, residuals)


@on_windows
def test_a_file_is_replaced_while_another_process_reads_it_all_the_time(tmp_path, read):
    path = tmp_path / "a.json"
    write_text(path, "0")
    read(0.03, path)
    for number in range(20):
        write_text(path, str(number))
        assert path.read_text() == str(number)
    assert contents(tmp_path) == {"a.json": "19"}


@on_windows
def test_a_file_that_another_process_keeps_open_stays_and_the_new_one_is_kept(tmp_path, read, monkeypatch):
    monkeypatch.setattr(open_files, "RETRY_SECONDS", 0.5)
    paths = [tmp_path / "a", tmp_path / "b"]
    for path in paths:
        path.write_text("old")
    read(60, paths[1])
    time.sleep(0.2)
    with (
        pytest.raises(OutputError, match="another program has it open; nothing was changed") as failed,
        atomic_write_all(*paths) as temporaries,
    ):
        for temporary in temporaries:
            temporary.write_text("new")
    assert exit_status(failed.value) == TRY_AGAIN
    assert contents(tmp_path) == {"a": "old", "b": "old", "new-a": "new", "new-b": "new"}


@on_windows
def test_a_recording_is_written_while_another_process_reads_it_all_the_time(tmp_path, read):
    rig, poses = make_rig(), 60
    matrices, residuals = random_poses(poses), random_residuals(poses)
    with RecordingWriter(tmp_path / "r", rig, partitions_of(rig), recording_info(poses)) as writer:
        read(0.02, *(tmp_path / "r" / name for name in ("recording.json", "residuals.npy")))
        for number in range(poses):
            writer.append(matrices[number : number + 1], residuals[number : number + 1])
            assert read_index(tmp_path / "r")["complete"] == number + 1
    assert np.array_equal(read_recording(tmp_path / "r").residuals, residuals)


@on_windows
def test_a_recording_that_is_mapped_is_neither_removed_nor_replaced(tmp_path, monkeypatch):
    monkeypatch.setattr(open_files, "RETRY_SECONDS", 0.2)
    record_limb(tmp_path / "r", 12)
    opened = read_recording(tmp_path / "r")
    with pytest.raises(OutputError, match=r"Cannot remove .*: another program has it open; end what uses it"):
        remove_recording(tmp_path / "r")
    check_recordable(tmp_path / "r", resume=False, overwrite=True)
    rig = make_rig()
    with pytest.raises(OutputError, match="another program has it open"):
        RecordingWriter(tmp_path / "r", rig, partitions_of(rig), recording_info(12), overwrite=True)
    assert np.array_equal(opened.residuals, read_recording(tmp_path / "r").residuals)
    del opened
    remove_recording(tmp_path / "r")
    assert not (tmp_path / "r").exists()
