# SPDX-License-Identifier: GPL-3.0-or-later
"""Time range of an Alembic file, which Blender does not expose to Python.

Only the container is read, Ogawa, which Alembic has written by default since 2013: "Ogawa", a byte that says whether
the file is complete, two bytes of version, and the position of the root group. A group is a number of children and
their positions, the highest bit set for data; data are a number of bytes and the bytes. The fifth child of the root is
the table of time samplings: for each the number of samples, the seconds of a cycle, and the times of a cycle
(Alembic's AbcCoreOgawa/WriteUtil, WriteTimeSampling).
"""

import struct
from pathlib import Path
from typing import BinaryIO

from .input_file import open_input

SIGNATURE = b"Ogawa"
TIME_SAMPLINGS_INDEX = 4
IS_DATA = 1 << 63
MAX_CHILDREN, MAX_BYTES = 64, 1 << 20
"""The root group has six children, and a table of time samplings has a few numbers for each rate."""
ACYCLIC = 1e30
"""Seconds of a cycle above which Alembic stores a time for each sample."""


def read_time_range(path: Path) -> tuple[float, float] | None:
    """Read the first and last second of the animation in an Alembic file.

    None where the file has another container (HDF5), is no Alembic file, is damaged, or has no animation.

    Raises:
        OSError: it cannot be opened.
    """
    with open_input(path) as file:
        try:
            return _time_range(_time_samplings(file))
        except (struct.error, ValueError, OverflowError):
            return None


def _time_samplings(file: BinaryIO) -> bytes:
    """Read the table of time samplings; raise ValueError or struct.error where there is none."""
    head = file.read(16)
    if head[:5] != SIGNATURE:
        raise ValueError("another container")
    file.seek(struct.unpack("<8xQ", head)[0])
    count = struct.unpack("<Q", file.read(8))[0]
    if not TIME_SAMPLINGS_INDEX < count <= MAX_CHILDREN:
        raise ValueError("another archive")
    child = struct.unpack(f"<{count}Q", file.read(8 * count))[TIME_SAMPLINGS_INDEX]
    if not child & IS_DATA:
        raise ValueError("no data")
    file.seek(child & ~IS_DATA)
    size = struct.unpack("<Q", file.read(8))[0]
    if size > MAX_BYTES:
        raise ValueError("too many samplings")
    return file.read(size)


def _time_range(table: bytes) -> tuple[float, float] | None:
    offset, found = 0, []
    while offset < len(table):
        samples, cycle, count = struct.unpack_from("<IdI", table, offset)
        times = struct.unpack_from(f"<{count}d", table, offset + 16)
        offset += 16 + 8 * count
        # A single sample is static; each table begins with one.
        if samples > 1 and times:
            last = times[min(samples, count) - 1] if cycle > ACYCLIC else 0.0
            if cycle <= ACYCLIC:
                cycles, rest = divmod(samples - 1, count)
                last = times[rest] + cycles * cycle
            found.append((times[0], last))
    return (min(first for first, _ in found), max(last for _, last in found)) if found else None
