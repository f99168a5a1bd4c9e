# SPDX-License-Identifier: GPL-3.0-or-later
"""A complete recording of the limb, and a folder on a disk that is nearly full."""

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

SMALL_DISK = 64 << 10
"""Bytes on the disk of `small_disk`."""


@pytest.fixture(scope="session")
def _recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("limb") / "recording"
    record_limb(path)
    return path


@pytest.fixture
def recording(_recorded: Path, tmp_path: Path) -> Path:
    """Folder of a complete recording of the limb, to be damaged."""
    return shutil.copytree(_recorded, tmp_path / "recording")


@pytest.fixture
def good() -> Recording:
    """A recording without a warning."""
    return good_recording()


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A folder on a disk of its own, of `SMALL_DISK` bytes."""
    if sys.platform == "win32":
        pytest.skip("Windows makes no small disks in memory.")
    folder = tmp_path / "small disk"
    folder.mkdir()
    libc = ctypes.CDLL(None, use_errno=True)
    if not hasattr(libc, "mount") or libc.mount(
        b"tmpfs", os.fsencode(folder), b"tmpfs", 0, f"size={SMALL_DISK}".encode()
    ):
        pytest.skip("Only root may mount a disk of its own; test_full_disk.py limits the size of files instead.")
    yield folder
    libc.umount2(os.fsencode(folder), 2)
