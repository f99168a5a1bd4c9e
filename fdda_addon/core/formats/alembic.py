# SPDX-License-Identifier: GPL-3.0-or-later
"""Time range of an Alembic file, which Blender does not expose to Python.

Only files in the container format Ogawa are read, which Alembic has written by default since 2013. Such a file begins
with "Ogawa", a byte that tells whether the file is complete, two bytes of version, and the position of the root group.
A group has the number of its children, then the position of each child; the highest bit of a position marks a data
block. A data block has the number of its bytes, then the bytes. The fifth child of the root group is the table of time
samplings. For each time sampling, the table has the number of samples, the duration of a cycle in seconds, the number
of times in a cycle, and these times (Alembic's AbcCoreOgawa/WriteUtil, WriteTimeSampling).
"""

import struct
from pathlib import Path
from typing import BinaryIO

from ..files.input_file import open_input

SIGNATURE = b"Ogawa"
TIME_SAMPLINGS_INDEX = 4
DATA_BLOCK_FLAG = 1 << 63
MAX_GROUP_CHILDREN, MAX_TABLE_BYTES = 64, 1 << 20
"""Limits against damaged files. The root group has six children; a table has a few numbers for each time sampling."""
MAX_CYCLE_SECONDS = 1e30
"""Seconds. For a longer cycle, Alembic stores a time for each sample."""


def read_time_range(path: Path) -> tuple[float, float] | None:
    """Read the times at which the animation of an Alembic file begins and ends.

    Returns:
        First and last time in seconds. None where the file has another container format (HDF5), is no Alembic file,
        is damaged, or has no animation.
    """
    with open_input(path) as file:
        try:
            return _compute_time_range(_read_time_samplings(file))
        except (struct.error, ValueError, OverflowError):
            return None


def _read_time_samplings(file: BinaryIO) -> bytes:
    """Read the table of time samplings; raise ValueError or struct.error where the file has none."""
    header = file.read(16)
    if header[:5] != SIGNATURE:
        raise ValueError("another container")
    file.seek(struct.unpack("<8xQ", header)[0])
    child_count = struct.unpack("<Q", file.read(8))[0]
    if not TIME_SAMPLINGS_INDEX < child_count <= MAX_GROUP_CHILDREN:
        raise ValueError("another archive")
    position = struct.unpack(f"<{child_count}Q", file.read(8 * child_count))[TIME_SAMPLINGS_INDEX]
    if not position & DATA_BLOCK_FLAG:
        raise ValueError("no data")
    file.seek(position & ~DATA_BLOCK_FLAG)
    size = struct.unpack("<Q", file.read(8))[0]
    if size > MAX_TABLE_BYTES:
        raise ValueError("too many samplings")
    return file.read(size)


def _compute_time_range(table: bytes) -> tuple[float, float] | None:
    """Compute the earliest and the latest time of all time samplings in a table; None where none is animated."""
    offset, time_ranges = 0, []
    while offset < len(table):
        sample_count, cycle_seconds, time_count = struct.unpack_from("<IdI", table, offset)
        times = struct.unpack_from(f"<{time_count}d", table, offset + 16)
        offset += 16 + 8 * time_count
        # A time sampling with one sample is static. Each table begins with such a time sampling.
        if sample_count > 1 and times:
            last_time = times[min(sample_count, time_count) - 1] if cycle_seconds > MAX_CYCLE_SECONDS else 0.0
            if cycle_seconds <= MAX_CYCLE_SECONDS:
                cycles, remainder = divmod(sample_count - 1, time_count)
                last_time = times[remainder] + cycles * cycle_seconds
            time_ranges.append((times[0], last_time))
    return (min(start for start, _ in time_ranges), max(end for _, end in time_ranges)) if time_ranges else None
