# SPDX-License-Identifier: GPL-3.0-or-later
"""Number of frames in the files of a Mesh Cache modifier, .pc2 and .mdd, read from their headers."""

import struct
from pathlib import Path

from ..errors import PointCacheError, os_error_text
from ..files.input_file import open_input

_PC2_HEADER = struct.Struct("<12siiffi")
"""The text "POINTCACHE2" and a zero byte, version, number of points, first frame, frames per sample, and number of
samples, little-endian. Float32 x, y, z of each point follow, sample by sample."""
_MDD_HEADER = struct.Struct(">ii")
"""Number of frames and number of points, big-endian. In float32 follow the time of each frame in seconds, then x, y, z
of each point, frame by frame."""


def read_frame_count(path: Path) -> int:
    """Return the number of frames in a .pc2 or .mdd file.

    Raises:
        PointCacheError: the file cannot be read, or its size contradicts its header.
    """
    header_format = _MDD_HEADER if path.suffix.lower() == ".mdd" else _PC2_HEADER
    try:
        with open_input(path) as file:
            header, size = file.read(header_format.size), path.stat().st_size
    except OSError as error:
        raise PointCacheError(f"The point cache '{path}' cannot be read: {os_error_text(error)}.") from error
    header = header.ljust(header_format.size, b"\0")
    if header_format is _MDD_HEADER:
        (frames, points), frame_header_size = header_format.unpack(header), 4
    else:
        signature, version, points, _, _, frames = header_format.unpack(header)
        frame_header_size = 0
        if (signature, version) != (b"POINTCACHE2\0", 1):
            raise PointCacheError(f"'{path}' is not a point cache of version 1; give a .pc2 file.")
    if frames < 1 or points < 1 or size != header_format.size + frames * (frame_header_size + 12 * points):
        raise PointCacheError(
            f"The point cache '{path}' is damaged: it has {size} bytes and its header says {frames} frames of {points} "
            "points; write it again."
        )
    return frames
