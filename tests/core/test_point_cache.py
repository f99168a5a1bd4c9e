# SPDX-License-Identifier: GPL-3.0-or-later
"""Point caches: the bytes are those of the format, and a damaged file is refused in a sentence."""

import struct

import numpy as np
import pytest

from fdda_addon.core.errors import PointCacheError
from fdda_addon.core.point_cache import PointCacheWriter, read_point_cache


@pytest.fixture
def positions() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(5, 7, 3)).astype(np.float32)


@pytest.fixture
def cache(positions, tmp_path):
    path = tmp_path / "a.pc2"
    with open(path, "wb") as file:
        writer = PointCacheWriter(file, 7, -3, 5)
        writer.append(positions[:2])
        # Not contiguous, and of another float.
        writer.append(positions[2:].astype(np.float64)[:, :, ::-1][:, :, ::-1])
        writer.finish()
    return path


def test_bytes(cache, positions):
    data = cache.read_bytes()
    assert data[:12] == b"POINTCACHE2\0" and len(data) == 32 + 5 * 7 * 12
    assert struct.unpack("<ii", data[12:20]) == (1, 7)
    assert struct.unpack("<ff", data[20:28]) == (-3.0, 1.0)
    assert struct.unpack("<i", data[28:32]) == (5,)
    assert struct.unpack("<3f", data[32 + 12 * 8 : 32 + 12 * 9]) == tuple(positions[1, 1].tolist())


def test_what_was_written_is_read(cache, positions):
    read = read_point_cache(cache)
    assert (read.start, read.rate) == (-3, 1)
    np.testing.assert_array_equal(read.positions, positions)


def test_no_sample_is_forgotten_or_added(tmp_path, positions):
    with open(tmp_path / "a.pc2", "wb") as file:
        writer = PointCacheWriter(file, 7, 1, 4)
        for wrong in (positions, positions[:, :6]):
            with pytest.raises(ValueError, match=r"where 4 of 7 points fit"):
                writer.append(wrong)
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
def test_damaged_files(cache, change, words):
    cache.write_bytes(change(cache.read_bytes()))
    with pytest.raises(PointCacheError, match=words):
        read_point_cache(cache)


def test_no_file(tmp_path):
    with pytest.raises(PointCacheError, match="cannot be read: No such file or directory"):
        read_point_cache(tmp_path / "none.pc2")
