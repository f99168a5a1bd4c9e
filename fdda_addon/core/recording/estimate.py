# SPDX-License-Identifier: GPL-3.0-or-later
"""Estimates of the disk space and the time that a recording needs, and a check of the free disk space."""

import math
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import DiskFullError
from ..files.output import nearest_existing_folder
from ..rig import Rig
from ..wording import format_count
from .arrays import rig_array_shapes

MIN_SHOWN_BYTES = 10**6
"""Smaller sizes are shown as "less than 1 MB"."""


@dataclass(frozen=True)
class Estimate:
    """Estimate of the remaining work of a recording.

    Attributes:
        poses: number of remaining poses.
        alone_poses: number of those in which one input moves alone.
        vertices: number of vertices of all meshes together.
        size_bytes: size of the complete recording.
        seconds: time for the remaining poses; None where unknown.
    """

    poses: int
    alone_poses: int
    vertices: int
    size_bytes: int
    seconds: float | None

    def sentence(self) -> str:
        """Format the estimate: "2,000 poses, each of 200,612 vertices: about 4.8 GB on the disk, about 12 minutes"."""
        time_text = "" if self.seconds is None else f", {format_duration(self.seconds)}"
        size_text = f"{'about ' if self.size_bytes >= MIN_SHOWN_BYTES else ''}{format_size(self.size_bytes)}"
        poses_text = format_poses(self.poses, self.alone_poses)
        return f"{poses_text}, each of {self.vertices:,} vertices: {size_text} on the disk{time_text}"


def format_poses(poses: int, alone_poses: int) -> str:
    """Format a number of poses: "4 poses, and 12 to find what each bone and input moves".

    Args:
        poses: number of all poses.
        alone_poses: number of those in which one input moves alone.
    """
    alone_text = f"{alone_poses:,} to find what each bone and input moves" if alone_poses else ""
    return ", and ".join(filter(None, (format_count(poses - alone_poses, "pose"), alone_text)))


def recording_bytes(rig: Rig, poses: int) -> int:
    """Return the size of the arrays of a recording in bytes; the size of the index is negligible."""
    shapes = rig_array_shapes(rig, poses).values()
    return sum(math.prod(shape) * np.dtype(dtype).itemsize for shape, dtype in shapes)


def free_bytes(folder: Path) -> int:
    """Return the free space of the disk with a folder, which need not exist, in bytes."""
    return shutil.disk_usage(nearest_existing_folder(folder)).free


def check_disk_space(folder: Path, size: int) -> None:
    """Check that the disk has enough free space for a recording.

    Args:
        folder: the folder, which may already have a part of the recording.
        size: size of the complete recording in bytes.

    Raises:
        DiskFullError: the disk has too little free space.
        OutputError: the folder has no existing parent.
    """
    # The length of a sparse file is larger than the space that it occupies.
    stats = [path.stat() for path in folder.glob("*.npy")]
    used_bytes = sum(getattr(stat, "st_blocks", -(-stat.st_size // 512)) * 512 for stat in stats)
    needed_bytes = size - min(size, used_bytes)
    available_bytes = free_bytes(folder)
    if needed_bytes > available_bytes:
        raise DiskFullError(
            f"Cannot write the recording '{folder}': it takes {format_size(needed_bytes)} and the disk has "
            f"{format_size(available_bytes)} left; make room, record fewer poses, or choose another folder."
        )


def format_size(size: int) -> str:
    """Format bytes as "4.8 GB", "12 MB" or "less than 1 MB"."""
    if size < MIN_SHOWN_BYTES:
        return "less than 1 MB"
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"


def format_duration(seconds: float) -> str:
    """Format seconds as "about 12 minutes"."""
    if seconds < 1.5:
        return "about a second"
    if seconds < 90:
        return f"about {seconds:.0f} seconds"
    if seconds < 90 * 60:
        return f"about {seconds / 60:.0f} minutes"
    return f"about {seconds / 3600:.1f} hours"
