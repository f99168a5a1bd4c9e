# SPDX-License-Identifier: GPL-3.0-or-later
"""Statistics of the residuals of a recording. The residuals may be larger than the memory."""

from dataclasses import dataclass

import numpy as np

from ..mathematics.partition import Partition
from ..recording.skinned import SkinnedRecording

MAX_SCANNED_POSES = 1000
MAX_KEPT_VERTICES, MAX_KEPT_IN_PARTITION, MIN_KEPT_IN_PARTITION = 8000, 48, 8
"""Numbers of vertices whose residuals are kept in memory: at most in total, at most and at least for one partition."""


@dataclass(frozen=True)
class ResidualScan:
    """Statistics of local residuals over poses, mesh units.

    Attributes:
        poses: (n,) ascending indices of the scanned poses, at most `MAX_SCANNED_POSES`, evenly spaced.
        rms: (V,) float64, rms of the length over the poses.
        largest: (V,) float32, largest length over the poses.
        largest_pose: (V,) int64, index of the pose in which the length is largest.
        vertices: for each partition, (S_p,) int64 indices of the vertices whose residuals are kept.
        residuals: for each partition, (n, S_p, 3) float32 residuals of these vertices.
    """

    poses: np.ndarray
    rms: np.ndarray
    largest: np.ndarray
    largest_pose: np.ndarray
    vertices: tuple[np.ndarray, ...]
    residuals: tuple[np.ndarray, ...]


def scan_residuals(recording: SkinnedRecording) -> ResidualScan:
    """Read the residuals of evenly spaced poses, a block of poses at a time."""
    pose_count, rig = len(recording.rows), recording.rig
    poses = np.unique(np.linspace(0, pose_count - 1, min(pose_count, MAX_SCANNED_POSES)).round().astype(np.int64))
    vertices_per_partition = min(
        MAX_KEPT_IN_PARTITION, max(MIN_KEPT_IN_PARTITION, MAX_KEPT_VERTICES // len(recording.partitions))
    )
    vertices = tuple(
        _choose_vertices(partition, rig.skin_weights, vertices_per_partition) for partition in recording.partitions
    )
    all_vertices = np.concatenate(vertices)
    kept_residuals = np.empty((len(poses), len(all_vertices), 3), np.float32)
    sum_of_squares = np.zeros(rig.vertex_count, np.float64)
    largest = np.full(rig.vertex_count, -1, np.float32)
    largest_pose = np.zeros(rig.vertex_count, np.int64)
    for row, residuals in enumerate(recording.iterate_residuals(poses)):
        kept_residuals[row] = residuals[all_vertices]
        squared_lengths = np.einsum("vc,vc->v", residuals, residuals)
        sum_of_squares += squared_lengths
        larger_vertices = np.flatnonzero(squared_lengths > largest)
        largest[larger_vertices], largest_pose[larger_vertices] = squared_lengths[larger_vertices], poses[row]
    ends = np.cumsum([len(partition_vertices) for partition_vertices in vertices])[:-1]
    return ResidualScan(
        poses,
        np.sqrt(sum_of_squares / len(poses)),
        np.sqrt(largest),
        largest_pose,
        vertices,
        tuple(np.split(kept_residuals, ends, axis=1)),
    )


def _choose_vertices(partition: Partition, skin_weights: np.ndarray, count: int) -> np.ndarray:
    """Choose `count` vertices of a partition: half with the most blended weights, half evenly spaced."""
    vertices = partition.vertices
    if len(vertices) <= count:
        return vertices.astype(np.int64)
    most_blended = vertices[np.argsort(skin_weights[vertices].max(axis=1), kind="stable")[: count // 2]]
    evenly_spaced = vertices[np.linspace(0, len(vertices) - 1, count - count // 2).round().astype(np.int64)]
    return np.union1d(most_blended, evenly_spaced).astype(np.int64)
