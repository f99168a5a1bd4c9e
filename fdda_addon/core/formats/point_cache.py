# SPDX-License-Identifier: GPL-3.0-or-later
"""Point caches: .pc2 files with the positions of a mesh by frame, which most 3D programs read.

The files are little-endian. The header has the text "POINTCACHE2" and a zero byte, int32 version, int32 number of
points, float32 first frame, float32 frames per sample, and int32 number of samples. Float32 x, y, z of each point
follow, sample by sample.
"""

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ..errors import PointCacheError, os_error_text

SIGNATURE = b"POINTCACHE2\0"
VERSION = 1
HEADER = struct.Struct("<12siiffi")


@dataclass(frozen=True)
class PointCache:
    """Content of a point cache.

    Attributes:
        start: frame of the first sample.
        rate: number of frames from one sample to the next.
        positions: (samples, points, 3) float32, mapped from disk.
    """

    start: float
    rate: float
    positions: np.ndarray


class PointCacheWriter:
    """Writes a point cache with one sample per frame; samples are appended in any number of calls."""

    def __init__(self, file: BinaryIO, points: int, start: int, samples: int):
        """Args:
        file: an empty file, open for writing.
        points: number of points of a sample.
        start: frame of the first sample.
        samples: number of samples.
        """
        self._file, self._points, self._missing = file, points, samples
        file.write(HEADER.pack(SIGNATURE, VERSION, points, start, 1.0, samples))

    def append(self, positions: np.ndarray) -> None:
        """Write (N, points, 3) samples, mesh units; raise ValueError for another shape or too many samples."""
        if positions.shape[1:] != (self._points, 3) or len(positions) > self._missing:
            raise ValueError(f"samples of shape {positions.shape} where {self._missing} of {self._points} points fit")
        self._missing -= len(positions)
        self._file.write(np.ascontiguousarray(positions, "<f4").data)

    def finish(self) -> None:
        """Raise ValueError where samples are missing."""
        if self._missing:
            raise ValueError(f"{self._missing} samples are missing")


def read_point_cache(path: Path) -> PointCache:
    """Open a point cache.

    Raises:
        PointCacheError: the file cannot be read, has another format, or its size contradicts its header.
    """
    try:
        with open(path, "rb") as file:
            header, size = file.read(HEADER.size), path.stat().st_size
    except OSError as error:
        raise PointCacheError(f"The point cache '{path}' cannot be read: {os_error_text(error)}.") from error
    if len(header) < HEADER.size or not header.startswith(SIGNATURE):
        raise PointCacheError(f"'{path}' is not a point cache; give a .pc2 file.")
    _, version, points, start, rate, samples = HEADER.unpack(header)
    if version != VERSION:
        raise PointCacheError(f"The point cache '{path}' is of version {version} and only version {VERSION} is read.")
    expected_size = HEADER.size + 12 * points * samples
    if points < 1 or samples < 1 or size != expected_size or not np.isfinite([start, rate]).all():
        raise PointCacheError(
            f"The point cache '{path}' is damaged: it has {size} bytes and its header says {samples} samples of "
            f"{points} points from frame {start:g} on; write it again."
        )
    positions = np.memmap(path, "<f4", "r", HEADER.size, (samples, points, 3))
    return PointCache(start, rate, positions)
