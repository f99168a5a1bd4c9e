# SPDX-License-Identifier: GPL-3.0-or-later
"""A disk that becomes full: the error says so in a sentence, and existing files stay."""

import os
import tempfile
from pathlib import Path

import pytest

from fdda_addon.core.errors import DiskFullError, OutputError
from fdda_addon.core.files.output import write_text
from fdda_addon.core.files.temporary import temporary_folder
from fdda_addon.core.recording.index import read_index
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.writer import RecordingWriter

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
            OutputError, match=rf"Cannot write the recording .*: {FULL_DISK_ERROR}; 20 of 100 poses are complete; make"
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
