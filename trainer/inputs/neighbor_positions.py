# SPDX-License-Identifier: GPL-3.0-or-later
"""The positions of nearby partitions, as inputs.

A smoothed surface depends on the positions of the surface around it. With parent-relative transforms alone, a network
would have to learn products of several transforms.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from fdda_addon.core.partition import Partition
from fdda_addon.core.rig import Rig

from ..fits.joint_paths import joints_on_path, static_joints
from ..graph_builder import GraphBuilder
from .block import MATRIX_COLUMNS, VECTOR_SIZE, FeatureBlock, LocalVectors, State


@dataclass(frozen=True)
class NeighborPositions(FeatureBlock):
    """Q points y of joints b in the spaces of main joints a, P_a^-1 P_b y: three features each, mesh units.

    Attributes:
        points: (M, 3) float32, points in the space of their joints, mesh units.
        point_joints: (M,) int64, their joints b.
        main_joints, pair_points: (Q,) int64, joints a, and indices of points y.
    """

    name = "neighbor_positions"
    points: np.ndarray
    point_joints: np.ndarray
    main_joints: np.ndarray
    pair_points: np.ndarray

    @classmethod
    def make(cls, rig: Rig, partitions: Sequence[Partition], state: State) -> Self:
        return cls.between(rig.parents, partition_centers(rig, partitions), partitions, static_joints(rig))

    @classmethod
    def between(
        cls,
        parents: np.ndarray,
        points: np.ndarray,
        partitions: Sequence[Partition],
        static: frozenset[int] = frozenset(),
    ) -> Self:
        """Choose the points that each partition depends on.

        The points of another joint are offered to a partition if every moving joint on the path between the two joints
        influences the partition, and there are at least two of these. A single joint on the path is already represented
        by its transform relative to its parent.

        Args:
            parents: (J,) parent index of each joint, -1 for a root.
            points: (J, S, 3) S points of each joint, in its space, mesh units.
            partitions: partitions with their main joints and influencing joints.
            static: joints that never move.
        """
        pairs, points_per_joint = [], points.shape[1]
        for partition in partitions:
            for joint in range(len(parents)):
                path = joints_on_path(parents, partition.joint, joint) - static
                if len(path) >= 2 and path <= set(partition.influencing):
                    first_point = joint * points_per_joint
                    pairs += [(partition.joint, first_point + index) for index in range(points_per_joint)]
        main_joints, pair_points = np.array(pairs, np.int64).reshape(-1, 2).T
        point_joints = np.repeat(np.arange(len(parents)), points_per_joint)
        return cls(points.reshape(-1, 3).astype(np.float32), point_joints, main_joints, pair_points)

    @property
    def length_mask(self) -> np.ndarray:
        return np.ones(VECTOR_SIZE * len(self.pair_points), bool)

    def offered(self, partition: Partition) -> np.ndarray:
        pairs = np.flatnonzero(self.main_joints == partition.joint)
        return (VECTOR_SIZE * pairs[:, None] + np.arange(VECTOR_SIZE)).ravel()

    def evaluate(self, pose_matrices: np.ndarray, controls: np.ndarray) -> np.ndarray:
        poses = pose_matrices.astype(np.float64)
        point_poses = poses[:, self.point_joints]
        points = np.einsum("nmab,mb->nma", point_poses[:, :, :3, :3], self.points) + point_poses[:, :, :3, 3]
        offsets = points[:, self.pair_points] - poses[:, :, :3, 3][:, self.main_joints]
        local_points = np.einsum("nqab,nqb->nqa", np.linalg.inv(poses[:, :, :3, :3])[:, self.main_joints], offsets)
        return local_points.reshape(len(poses), -1).astype(np.float32)

    def add_nodes(self, graph: GraphBuilder, is_needed: np.ndarray) -> tuple[LocalVectors, np.ndarray]:
        points = np.unique(self.pair_points)
        offsets = np.tile(np.eye(4), (len(points), 1, 1))
        offsets[:, :3, 3] = self.points[points]
        main_spaces, translation = len(points) + self.main_joints, np.full(len(self.pair_points), MATRIX_COLUMNS - 1)
        ends, origins = (
            np.stack([spaces, translation], axis=1)
            for spaces in (np.searchsorted(points, self.pair_points), main_spaces)
        )
        vectors = LocalVectors(self.point_joints[points], offsets, main_spaces, ends, origins)
        return vectors, np.arange(len(is_needed))


def partition_centers(rig: Rig, partitions: Sequence[Partition]) -> np.ndarray:
    """Compute the center of each joint's partition.

    Returns:
        (J, 1, 3) float64, in the space of the joint, mesh units; 0 for a joint without vertices.
    """
    points = np.zeros((len(rig.joints), 1, 3))
    for partition in partitions:
        center = np.append(rig.rest_positions[partition.vertices].mean(axis=0, dtype=np.float64), 1)
        points[partition.joint, 0] = (np.linalg.inv(rig.rest_matrices[partition.joint].astype(np.float64)) @ center)[:3]
    return points
