# SPDX-License-Identifier: GPL-3.0-or-later
"""What a recording will take of disk and time, said before its first pose, and a refusal where there is no room."""

import math
import os
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import DiskFullError
from ..output import nearest_existing_folder
from ..rig import STATIC_JOINT_LABEL, Rig
from .arrays import array_shapes
from .reader import Recording

MIN_SIZE = 10**6


@dataclass(frozen=True)
class Estimate:
    """What is left to record.

    Attributes:
        poses: how many are left.
        vertices: of all meshes together.
        size: of the complete recordings, bytes.
        seconds: that the poses will take, None when nobody knows.
    """

    poses: int
    vertices: int
    size: int
    seconds: float | None

    def sentence(self) -> str:
        """ "2,000 poses of 200,612 vertices: about 4.8 GB on the disk, about 12 minutes"."""
        poses = "1 pose" if self.poses == 1 else f"{self.poses:,} poses"
        time = "" if self.seconds is None else f", {duration_in_words(self.seconds)}"
        size = f"{'about ' if self.size >= MIN_SIZE else ''}{size_in_words(self.size)}"
        return f"{poses} of {self.vertices:,} vertices: {size} on the disk{time}"


def recording_bytes(rig: Rig, poses: int) -> int:
    """Bytes that the arrays of a recording take; the index is small beside them."""
    shapes = array_shapes(
        *(poses, len(rig.joints), rig.vertex_count, rig.skin_joints.shape[1]),
        *(len(rig.face_starts), len(rig.face_vertices), len(rig.controls)),
    )
    return sum(math.prod(shape) * np.dtype(dtype).itemsize for shape, dtype in shapes.values())


def sizes_in_words(recording: Recording) -> str:
    """A sentence about what a training on a recording takes: of the disk, and most of the memory."""
    poses, rig = len(recording.pose_matrices), recording.rig
    largest = max(recording.partitions, key=lambda partition: len(partition.vertices))
    vertices = len(largest.vertices)
    return (
        f"{poses:,} poses of {rig.vertex_count:,} vertices: {size_in_words(recording_bytes(rig, poses))} on the disk; "
        f"residuals of the largest partition, '{rig.joints[largest.joint].name or STATIC_JOINT_LABEL}', of "
        f"{vertices:,} vertices: {size_in_words(12 * poses * vertices)}, in memory two or three times."
    )


def check_room(sizes: Iterable[tuple[Path, int]]) -> None:
    """Fail when the disk lacks the room for recordings.

    Args:
        sizes: folder of each recording, which may hold a part of it already, and its bytes when it is complete. All lie
            on one disk.

    Raises:
        DiskFullError: says how much there is and how much it takes.
        OutputError: no folder above one of them exists.
    """
    sizes = list(sizes)
    needed = sum(size - min(size, _taken(folder)) for folder, size in sizes)
    folder = sizes[0][0]
    free = shutil.disk_usage(nearest_existing_folder(folder)).free
    if needed > free:
        raise DiskFullError(
            f"Cannot write the recording '{folder}': it takes {size_in_words(needed)} and the disk has "
            f"{size_in_words(free)} left; make room, record fewer poses, or choose another folder."
        )


def _taken(folder: Path) -> int:
    """Bytes of the disk that a recording has already: its files are longer than what is written of them."""
    if not os.path.isdir(folder):
        return 0
    stats = [path.stat() for path in folder.glob("*.npy")]
    return sum(getattr(stat, "st_blocks", -(-stat.st_size // 512)) * 512 for stat in stats)


def size_in_words(size: int) -> str:
    """Bytes as "4.8 GB", "12 MB" or "less than 1 MB"."""
    if size < MIN_SIZE:
        return "less than 1 MB"
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"


def duration_in_words(seconds: float) -> str:
    """Seconds as "about 12 minutes"."""
    if seconds < 1.5:
        return "about a second"
    if seconds < 90:
        return f"about {seconds:.0f} seconds"
    if seconds < 90 * 60:
        return f"about {seconds / 60:.0f} minutes"
    return f"about {seconds / 3600:.1f} hours"
