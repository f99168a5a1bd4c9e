# SPDX-License-Identifier: GPL-3.0-or-later
"""The input features of the networks: joint transforms, controls, positions of other partitions, and surface frames.

A smoothed surface depends on the positions of the surface around it. With parent-relative transforms alone, a network
would have to learn products of several transforms. So its inputs also include the centers of nearby partitions in the
space of its main joint and, if the rig smooths, surface frames (`surface_frames`). docs/experiments.md compares the
errors with and without them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fdda_addon.core.features import FEATURES_PER_JOINT, joint_features
from fdda_addon.core.partition import Partition
from fdda_addon.core.rig import STATIC_JOINT, Rig

from .surface_frames import FEATURES_PER_SURFACE_FRAME, NO_SURFACE_FRAMES, SurfaceFrameFeatures

FEATURES_PER_PAIR = 3


@dataclass(frozen=True)
class NetworkInputs:
    """All input features, F = 12 J + C + 3 Q + 3 D in a row, and the features of each network.

    In this order: J transforms of joints relative to their parents (`core.features`); C controls, each in its own unit;
    Q points y of joints b in the space of joints a, P_a^-1 P_b y, in mesh units; D surface frames, in mesh units.

    Attributes:
        parents: (J,) int32, parent of each joint, -1 for a root.
        control_count: C.
        points: (M, 3) float32, points that move with joints, in the space of their joints, mesh units.
        point_joints: (M,) int64, their joints b.
        pair_references, pair_points: (Q,) int64, joints a and indices of points y.
        columns: for each partition, (F_p,) int64 indices of the features that are offered to its network.
        surface_frames: D surface frames.
    """

    parents: np.ndarray
    control_count: int
    points: np.ndarray
    point_joints: np.ndarray
    pair_references: np.ndarray
    pair_points: np.ndarray
    columns: tuple[np.ndarray, ...]
    surface_frames: SurfaceFrameFeatures = NO_SURFACE_FRAMES

    @property
    def control_start(self) -> int:
        """First column of the controls, 12 J."""
        return len(self.parents) * FEATURES_PER_JOINT

    @property
    def pair_start(self) -> int:
        """First column of the pairs, 12 J + C. Pairs are functions of the joints."""
        return self.control_start + self.control_count

    @property
    def surface_frame_start(self) -> int:
        """First column of the surface frames, 12 J + C + 3 Q. Surface frames are functions of the joints."""
        return self.pair_start + FEATURES_PER_PAIR * len(self.pair_points)

    @property
    def feature_count(self) -> int:
        """Number of features, F."""
        return self.surface_frame_start + FEATURES_PER_SURFACE_FRAME * len(self.surface_frames)

    def length_mask(self) -> np.ndarray:
        """Return (F,) bool, which features are lengths in mesh units."""
        index = np.arange(self.feature_count)
        return (index >= self.pair_start) | ((index < self.control_start) & (index % 4 == 3))

    def with_surface_frames(
        self, surface_frames: SurfaceFrameFeatures, partitions: Sequence[Partition]
    ) -> "NetworkInputs":
        """Add surface frames, and offer each network the surface frames of its partition."""
        columns = []
        for partition, partition_columns in zip(partitions, self.columns, strict=True):
            indices = np.flatnonzero(surface_frames.main_joints == partition.joint)
            added_columns = [_columns(self.surface_frame_start, index, FEATURES_PER_SURFACE_FRAME) for index in indices]
            columns.append(np.concatenate([partition_columns, *added_columns]))
        return replace(self, columns=tuple(columns), surface_frames=surface_frames)

    def compute_features(
        self, pose_matrices: np.ndarray, rest_matrices: np.ndarray, controls: np.ndarray | None = None
    ) -> np.ndarray:
        """Compute the features of poses.

        Args:
            pose_matrices: (N, J, 4, 4), mesh-object space, mesh units.
            rest_matrices: (J, 4, 4), mesh-object space, mesh units.
            controls: (N, C) values; None if C is 0.

        Returns:
            (N, F) float32.

        Raises:
            ValueError: the controls have another shape.
        """
        control_values, expected_shape = controls, (len(pose_matrices), self.control_count)
        if control_values is None:
            control_values = np.zeros((len(pose_matrices), 0))
        if control_values.shape != expected_shape:
            raise ValueError(f"values of controls are {control_values.shape} and should be {expected_shape}")
        joints = joint_features(pose_matrices, rest_matrices, self.parents).reshape(len(pose_matrices), -1)
        poses = pose_matrices.astype(np.float64)
        point_poses = poses[:, self.point_joints]
        points = np.einsum("nmab,mb->nma", point_poses[:, :, :3, :3], self.points) + point_poses[:, :, :3, 3]
        offsets = points[:, self.pair_points] - poses[:, :, :3, 3][:, self.pair_references]
        local_points = np.einsum("nqab,nqb->nqa", np.linalg.inv(poses[:, :, :3, :3])[:, self.pair_references], offsets)
        feature_groups = [
            joints,
            control_values.astype(np.float32),
            local_points.reshape(len(poses), -1).astype(np.float32),
        ]
        return np.concatenate([*feature_groups, self.surface_frames.evaluate(pose_matrices)], axis=1)


def inputs_of_rig(rig: Rig, points: np.ndarray, partitions: Sequence[Partition]) -> NetworkInputs:
    """Choose the inputs of a rig's networks; `points` and `partitions` as in `make_inputs`."""
    return make_inputs(rig.parents, points, partitions, len(rig.controls), static_joints(rig))


def inputs_with_surface_frames(
    rig: Rig, partitions: Sequence[Partition], surface_frames: SurfaceFrameFeatures
) -> NetworkInputs:
    """Choose the inputs of a rig's networks, with the centers of its partitions and surface frames."""
    inputs = inputs_of_rig(rig, partition_centers(rig, partitions), partitions)
    return inputs.with_surface_frames(surface_frames, partitions)


def make_inputs(
    parents: np.ndarray,
    points: np.ndarray,
    partitions: Sequence[Partition],
    control_count: int = 0,
    static: frozenset[int] = frozenset(),
) -> NetworkInputs:
    """Choose the inputs of the networks.

    The inputs of a partition include the points of another joint if every moving joint on the path between the two
    joints influences the partition, and there are at least two of these. A single joint on the path is already
    represented by its transform relative to its parent.

    Args:
        parents: (J,) parent index of each joint, -1 for a root.
        points: (J, S, 3) S points of each joint, in its space, mesh units; see `partition_centers`.
        partitions: partitions with their main joints, influencing joints and controls.
        control_count: number of controls, C.
        static: joints that never move.
    """
    references, pair_points, columns = [], [], []
    points_per_joint, control_start = points.shape[1], len(parents) * FEATURES_PER_JOINT
    for partition in partitions:
        partition_columns = [_columns(0, joint, FEATURES_PER_JOINT) for joint in partition.influencing]
        partition_columns += [_columns(control_start, control, 1) for control in partition.controls]
        for joint in range(len(parents)):
            path = joints_on_path(parents, partition.joint, joint) - static
            if len(path) >= 2 and path <= set(partition.influencing):
                for point in range(joint * points_per_joint, (joint + 1) * points_per_joint):
                    pair_columns = _columns(control_start + control_count, len(pair_points), FEATURES_PER_PAIR)
                    partition_columns.append(pair_columns)
                    references.append(partition.joint)
                    pair_points.append(point)
        columns.append(np.concatenate([*partition_columns, np.zeros(0, np.int64)]))
    return NetworkInputs(
        parents,
        control_count,
        points.reshape(-1, 3).astype(np.float32),
        np.repeat(np.arange(len(parents)), points_per_joint),
        np.array(references, np.int64),
        np.array(pair_points, np.int64),
        tuple(columns),
    )


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


def static_joints(rig: Rig) -> frozenset[int]:
    """Return the joints of a rig that never move; they influence nothing."""
    return frozenset(index for index, joint in enumerate(rig.joints) if joint.name == STATIC_JOINT)


def _columns(start: int, index: int, width: int) -> np.ndarray:
    return start + index * width + np.arange(width)


def joints_on_path(parents: np.ndarray, first: int, second: int) -> set[int]:
    """Return the joints whose parent-relative transforms compose the transform of one joint relative to another.

    Without a common ancestor, these are all joints from either one up to its root.
    """
    return set(_chain_to_root(parents, first)) ^ set(_chain_to_root(parents, second))


def _chain_to_root(parents: np.ndarray, joint: int) -> list[int]:
    chain = []
    while joint >= 0:
        chain.append(joint)
        joint = int(parents[joint])
    return chain
