# SPDX-License-Identifier: GPL-3.0-or-later
"""Point caches: files have the bytes of the PC2 format, and a damaged file is refused in one sentence."""

import struct

import numpy as np
import pytest

from fdda_addon.core.errors import PointCacheError
from fdda_addon.core.formats.point_cache import PointCacheWriter, read_point_cache


@pytest.fixture
def positions() -> np.ndarray:
    """Positions of seven points in five samples."""
    return np.random.default_rng(0).normal(size=(5, 7, 3)).astype(np.float32)


@pytest.fixture
def cache_path(positions, tmp_path):
    """Path of a point cache of seven points, five samples from frame -3 on."""
    path = tmp_path / "a.pc2"
    with open(path, "wb") as file:
        writer = PointCacheWriter(file, 7, -3, 5)
        writer.append(positions[:2])
        # An array that is not contiguous, of another floating-point type.
        writer.append(positions[2:].astype(np.float64)[:, :, ::-1][:, :, ::-1])
        writer.finish()
    return path


def test_bytes_follow_the_format(cache_path, positions):
    data = cache_path.read_bytes()
    assert data[:12] == b"POINTCACHE2\0" and len(data) == 32 + 5 * 7 * 12
    assert struct.unpack("<ii", data[12:20]) == (1, 7)
    assert struct.unpack("<ff", data[20:28]) == (-3.0, 1.0)
    assert struct.unpack("<i", data[28:32]) == (5,)
    assert struct.unpack("<3f", data[32 + 12 * 8 : 32 + 12 * 9]) == tuple(positions[1, 1].tolist())


def test_positions_are_read_back(cache_path, positions):
    read_back = read_point_cache(cache_path)
    assert (read_back.start, read_back.rate) == (-3, 1)
    np.testing.assert_array_equal(read_back.positions, positions)


def test_a_wrong_number_of_samples_or_points_is_refused(tmp_path, positions):
    with open(tmp_path / "a.pc2", "wb") as file:
        writer = PointCacheWriter(file, 7, 1, 4)
        for wrong_positions in (positions, positions[:, :6]):
            with pytest.raises(ValueError, match=r"where 4 of 7 points fit"):
                writer.append(wrong_positions)
        writer.append(positions[:3])
        with pytest.raises(ValueError, match="1 samples are missing"):
            writer.finish()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda data: b"", "is not a point cache; give a .pc2 file"),
        (lambda data: b"text" * 20, "is not a point cache; give a .pc2 file"),
        (lambda data: data[:31], "is not a point cache"),
        (lambda data: data[:12] + struct.pack("<i", 2) + data[16:], "is of version 2 and only version 1 is read"),
        (lambda data: data[:-1], "is damaged: it has 451 bytes and its header says 5 samples of 7 points"),
        (lambda data: data + b"\0", "is damaged: it has 453 bytes"),
        (lambda data: data[:16] + struct.pack("<i", -7) + data[20:], "its header says 5 samples of -7 points"),
        (lambda data: data[:28] + struct.pack("<i", 2**31 - 1) + data[32:], "says 2147483647 samples"),
        (lambda data: data[:20] + struct.pack("<f", np.nan) + data[24:], "from frame nan on"),
    ],
)
def test_damaged_files_are_refused(cache_path, change, words):
    cache_path.write_bytes(change(cache_path.read_bytes()))
    with pytest.raises(PointCacheError, match=words):
        read_point_cache(cache_path)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(PointCacheError, match="cannot be read: No such file or directory"):
        read_point_cache(tmp_path / "none.pc2")
