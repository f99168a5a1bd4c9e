# SPDX-License-Identifier: GPL-3.0-or-later
"""One look at the residuals of a recording, which may be larger than memory."""

from dataclasses import dataclass

import numpy as np

from ..partition import Partition
from ..recording.reader import Recording

MAX_POSES = 1000
SAMPLED_VERTICES, SAMPLED_IN_PARTITION, MIN_IN_PARTITION = 8000, 48, 8
"""How many vertices are kept pose by pose, in all and of one partition."""


@dataclass(frozen=True)
class ResidualScan:
    """What the poses of a recording say of its residuals; local residuals, metres.

    Attributes:
        poses: (n,) indices of the poses that were looked at, ascending; at most `MAX_POSES`, evenly spaced.
        rms: (V,) float64, rms length over the poses.
        largest: (V,) float32, largest length.
        largest_pose: (V,) int64, index of the pose in which it is largest.
        change: (V,) float32, farthest from the residual in the first pose.
        vertices: for each partition, the (S_p,) int64 vertices that were kept.
        residuals: for each partition, their (n, S_p, 3) float32 residuals.
    """

    poses: np.ndarray
    rms: np.ndarray
    largest: np.ndarray
    largest_pose: np.ndarray
    change: np.ndarray
    vertices: tuple[np.ndarray, ...]
    residuals: tuple[np.ndarray, ...]


def scan_residuals(recording: Recording) -> ResidualScan:
    """Read the residuals of evenly spaced poses, one pose in memory at a time."""
    count, rig = len(recording.residuals), recording.rig
    poses = np.unique(np.linspace(0, count - 1, min(count, MAX_POSES)).round().astype(np.int64))
    most = min(SAMPLED_IN_PARTITION, max(MIN_IN_PARTITION, SAMPLED_VERTICES // len(recording.partitions)))
    vertices = tuple(_sampled(p, rig.skin_weights, most) for p in recording.partitions)
    gathered = np.concatenate(vertices)
    kept = np.empty((len(poses), len(gathered), 3), np.float32)
    squares = np.zeros(rig.vertex_count, np.float64)
    largest = np.full(rig.vertex_count, -1, np.float32)
    change = np.zeros(rig.vertex_count, np.float32)
    largest_pose = np.zeros(rig.vertex_count, np.int64)
    first = np.array(recording.residuals[0])
    for row, pose in enumerate(poses):
        residuals = np.array(recording.residuals[pose])
        kept[row] = residuals[gathered]
        square = np.einsum("vc,vc->v", residuals, residuals)
        squares += square
        larger = np.flatnonzero(square > largest)
        largest[larger], largest_pose[larger] = square[larger], pose
        residuals -= first
        np.maximum(change, np.einsum("vc,vc->v", residuals, residuals), out=change)
    ends = np.cumsum([len(own) for own in vertices])[:-1]
    return ResidualScan(
        poses,
        np.sqrt(squares / len(poses)),
        np.sqrt(largest),
        largest_pose,
        np.sqrt(change),
        vertices,
        tuple(np.split(kept, ends, axis=1)),
    )


def _sampled(partition: Partition, skin_weights: np.ndarray, most: int) -> np.ndarray:
    """Vertices that stand for a partition: half of them the most blended ones, half spread over it."""
    own = partition.vertices
    if len(own) <= most:
        return own.astype(np.int64)
    blended = own[np.argsort(skin_weights[own].max(axis=1), kind="stable")[: most // 2]]
    spread = own[np.linspace(0, len(own) - 1, most - most // 2).round().astype(np.int64)]
    return np.union1d(blended, spread).astype(np.int64)
