# SPDX-License-Identifier: GPL-3.0-or-later
"""Number of frames in the files of a Mesh Cache modifier, .pc2 and .mdd, read from their headers."""

import struct
from pathlib import Path

from ..errors import PointCacheError, os_error_text
from ..files.input_file import open_input
from .point_cache import read_point_cache

_MDD_HEADER = struct.Struct(">ii")
"""Number of frames and number of points, big-endian. In float32 follow the time of each frame in seconds, then x, y, z
of each point, frame by frame."""


def read_frame_count(path: Path) -> int:
    """Return the number of frames in a .pc2 or .mdd file.

    Raises:
        PointCacheError: the file cannot be read, or its size contradicts its header.
    """
    if path.suffix.lower() != ".mdd":
        return len(read_point_cache(path).positions)
    try:
        with open_input(path) as file:
            header, size = file.read(_MDD_HEADER.size), path.stat().st_size
    except OSError as error:
        raise PointCacheError(f"The point cache '{path}' cannot be read: {os_error_text(error)}.") from error
    frames, points = _MDD_HEADER.unpack(header) if len(header) == _MDD_HEADER.size else (0, 0)
    if frames < 1 or points < 1 or size != _MDD_HEADER.size + 4 * frames + 12 * frames * points:
        raise PointCacheError(
            f"The point cache '{path}' is damaged: it has {size} bytes and its header says {frames} frames of {points} "
            "points; write it again."
        )
    return frames
