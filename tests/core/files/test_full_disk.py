# SPDX-License-Identifier: GPL-3.0-or-later
"""A disk that becomes full: the error says so in a sentence, and existing files stay."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from fdda_addon.core.errors import DiskFullError, OutputError
from fdda_addon.core.files.output import write_text
from fdda_addon.core.files.temporary import temporary_folder
from fdda_addon.core.recording.index import read_index
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.writer import RecordingWriter

from ... import systems
from ..conftest import SMALL_DISK_BYTES
from ..limb import make_rig, random_poses, random_positions, record_limb, recording_info

ROOT = Path(__file__).resolve().parents[3]
FULL_DISK_ERROR = "No space left on device"


def test_a_file_that_does_not_fit_leaves_the_old_file(small_disk):
    path = small_disk / "report.json"
    path.write_text("old")
    with pytest.raises(OutputError, match=f"Cannot write '{path}': {FULL_DISK_ERROR}; nothing was changed"):
        write_text(path, "x" * 2 * SMALL_DISK_BYTES)
    assert path.read_text() == "old"
    assert [p.name for p in small_disk.iterdir()] == ["report.json"]


def test_a_recording_that_does_not_fit_is_refused_before_the_first_pose(small_disk):
    with pytest.raises(
        OutputError, match=rf"Cannot write the recording .*: {FULL_DISK_ERROR}; make room or choose another"
    ):
        record_limb(small_disk / "recording", poses=2000, complete=10)
    assert list(small_disk.iterdir()) == []


@pytest.mark.parametrize("kind", ["write", "output", "blender"])
def test_a_full_temporary_disk_is_the_machines_fault(small_disk, monkeypatch, kind):
    monkeypatch.setattr(tempfile, "tempdir", str(small_disk))
    with (
        pytest.raises(DiskFullError, match=rf"^No temporary file can be written \(.*{FULL_DISK_ERROR}.*\); make room"),
        temporary_folder() as folder,
    ):
        if kind == "write":
            (folder / "a").write_bytes(bytes(2 * SMALL_DISK_BYTES))
        if kind == "output":
            write_text(folder / "a", "x" * 2 * SMALL_DISK_BYTES)
        raise OutputError(f"Cannot write '{folder / 'a'}': {FULL_DISK_ERROR}")  # as of Blender, without an errno
    assert list(small_disk.iterdir()) == []


def test_an_error_of_another_folder_is_no_error_of_the_temporary_folder():
    for error in (OutputError("Cannot write '/other/a'"), FileNotFoundError(2, "missing", "/other/a")):
        with pytest.raises(type(error)) as raised, temporary_folder() as folder:
            raise error
        assert raised.value is error and not folder.exists()


@pytest.fixture
def _no_space_reservation(monkeypatch):
    """Remove the function that reserves space for a file, which some systems lack."""
    monkeypatch.delattr(os, "posix_fallocate", raising=False)


@pytest.mark.usefixtures("_no_space_reservation")
def test_a_disk_that_fills_up_during_a_recording_leaves_complete_poses(small_disk, tmp_path):
    path, rig, poses = small_disk / "recording", make_rig(), 100
    matrices, residuals = random_poses(poses), random_positions(poses)
    ballast = small_disk / "ballast"
    with (
        pytest.raises(
            OutputError, match=rf"Cannot write the recording .*: {FULL_DISK_ERROR}; 20 of 100 poses are complete, cont"
        ),
        RecordingWriter(path, rig, recording_info(poses)) as writer,
    ):
        writer.append(matrices[:20], residuals[:20])
        ballast.write_bytes(b"x" * (os.statvfs(small_disk).f_bavail - 4) * 4096)
        writer.append(matrices[20:90], residuals[20:90])
    assert read_index(path)["complete"] == 20
    ballast.unlink()
    # There is space again, but not for the whole recording, so a copy on another disk is resumed.
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    for file in path.iterdir():
        (elsewhere / file.name).write_bytes(file.read_bytes())
    record_limb(elsewhere, poses, resume=True)
    assert (read_recording(elsewhere).positions == residuals).all()


WRITE_WITH_SIZE_LIMIT = """
import resource, sys
from pathlib import Path
from fdda_addon.core.errors import OutputError
from fdda_addon.core.files.output import write_text
from tests.core.limb import record_limb
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
folder = Path(sys.argv[1])
for write in (lambda: record_limb(folder / "recording", 500), lambda: write_text(folder / "old.txt", "x" * 30_000)):
    try:
        write()
    except OutputError as error:
        print(error)
"""


@systems.file_size_limits
def test_file_size_limit_is_reported(tmp_path):
    (tmp_path / "old.txt").write_text("old")
    command = [sys.executable, "-c", WRITE_WITH_SIZE_LIMIT, str(tmp_path)]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.stdout.splitlines() == [
        f"Cannot write the recording '{tmp_path}/recording': File too large; make room or choose another folder.",
        f"Cannot write '{tmp_path}/old.txt': File too large; nothing was changed.",
    ], result.stderr
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("old.txt", "old")]
