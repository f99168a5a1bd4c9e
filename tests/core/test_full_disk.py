# SPDX-License-Identifier: GPL-3.0-or-later
"""A disk that fills up: a sentence, and what was there before is still there."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fdda_addon.core.errors import OutputError
from fdda_addon.core.output import write_text
from fdda_addon.core.recording.index import read_index
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.writer import RecordingWriter

from .. import systems
from .conftest import SMALL_DISK
from .limb import make_rig, partitions_of, random_poses, random_residuals, record_limb, recording_info

ROOT = Path(__file__).resolve().parents[2]
FULL = "No space left on device"


def test_a_file_that_does_not_fit_leaves_the_old_one(small_disk):
    path = small_disk / "report.json"
    path.write_text("old")
    with pytest.raises(OutputError, match=f"Cannot write '{path}': {FULL}; nothing was changed"):
        write_text(path, "x" * 2 * SMALL_DISK)
    assert path.read_text() == "old"
    assert [p.name for p in small_disk.iterdir()] == ["report.json"]


def test_a_recording_that_does_not_fit_is_refused_before_the_first_pose(small_disk):
    with pytest.raises(OutputError, match=rf"Cannot write the recording .*: {FULL}; make room or choose another"):
        record_limb(small_disk / "recording", poses=2000, complete=10)
    assert list(small_disk.iterdir()) == []


@pytest.fixture
def _unreserved(monkeypatch):
    """As on a system that cannot reserve space for a file."""
    monkeypatch.delattr(os, "posix_fallocate", raising=False)


@pytest.mark.usefixtures("_unreserved")
def test_a_disk_that_fills_up_while_recording_leaves_what_was_complete(small_disk, tmp_path):
    path, rig, poses = small_disk / "recording", make_rig(), 100
    matrices, residuals = random_poses(poses), random_residuals(poses)
    ballast = small_disk / "ballast"
    with (
        pytest.raises(OutputError, match=rf"Cannot write the recording .*: {FULL}; 20 of 100 poses are complete, cont"),
        RecordingWriter(path, rig, partitions_of(rig), recording_info(poses)) as writer,
    ):
        writer.append(matrices[:20], residuals[:20])
        ballast.write_bytes(b"x" * (os.statvfs(small_disk).f_bavail - 4) * 4096)
        writer.append(matrices[20:90], residuals[20:90])
    assert read_index(path)["complete"] == 20
    ballast.unlink()
    # Room again, though not for the whole of it: the poses that are there can be carried on elsewhere.
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    for file in path.iterdir():
        (elsewhere / file.name).write_bytes(file.read_bytes())
    record_limb(elsewhere, poses, resume=True)
    assert (read_recording(elsewhere).residuals == residuals).all()


LIMITED = """
import resource, sys
from pathlib import Path
from fdda_addon.core.errors import OutputError
from fdda_addon.core.output import write_text
from tests.core.limb import record_limb
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
folder = Path(sys.argv[1])
for job in (lambda: record_limb(folder / "recording", 500), lambda: write_text(folder / "old.txt", "x" * 30_000)):
    try:
        job()
    except OutputError as error:
        print(error)
"""


@systems.file_size_limits
def test_files_that_may_not_grow(tmp_path):
    (tmp_path / "old.txt").write_text("old")
    command = [sys.executable, "-c", LIMITED, str(tmp_path)]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.stdout.splitlines() == [
        f"Cannot write the recording '{tmp_path}/recording': File too large; make room or choose another folder.",
        f"Cannot write '{tmp_path}/old.txt': File too large; nothing was changed.",
    ], result.stderr
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("old.txt", "old")]
