# SPDX-License-Identifier: GPL-3.0-or-later
"""Fixtures of the core tests: a recording of the limb, a recording without warnings, and a disk of 64 KiB."""

import ctypes
import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from fdda_addon.core.recording.reader import Recording

from .good_recording import good_recording
from .limb import record_limb

SMALL_DISK_BYTES = 64 << 10
"""Size of the disk that the fixture `small_disk` mounts."""


@pytest.fixture(scope="session")
def _limb_recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a complete recording of the limb, made once for all tests."""
    path = tmp_path_factory.mktemp("limb") / "recording"
    record_limb(path)
    return path


@pytest.fixture
def recording(_limb_recording: Path, tmp_path: Path) -> Path:
    """Folder of a complete recording of the limb, a copy that the test may damage."""
    return shutil.copytree(_limb_recording, tmp_path / "recording")


@pytest.fixture
def clean_recording() -> Recording:
    """A recording in memory that causes no warning."""
    return good_recording()


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """Mount a disk of `SMALL_DISK_BYTES` in memory and yield its folder; skip the test where that is impossible."""
    if sys.platform == "win32":
        pytest.skip("Windows cannot mount a small disk in memory.")
    folder = tmp_path / "small disk"
    folder.mkdir()
    libc = ctypes.CDLL(None, use_errno=True)
    if not hasattr(libc, "mount") or libc.mount(
        b"tmpfs", os.fsencode(folder), b"tmpfs", 0, f"size={SMALL_DISK_BYTES}".encode()
    ):
        pytest.skip("Only root may mount a disk; one test of test_output.py limits the size of files instead.")
    yield folder
    libc.umount2(os.fsencode(folder), 2)
