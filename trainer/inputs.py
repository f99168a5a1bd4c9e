# SPDX-License-Identifier: GPL-3.0-or-later
"""What each network sees: its joints relative to their parents, its controls, where its neighbors are, and deltas.

A smoothed surface depends on where the surface around it is. From the parent-relative transforms a network would have
to multiply its way to that; so it is also given the middle of the partitions around it, seen from its main joint, and
where the rig smooths, how some vertices stand out of the smoothed surface (`deltas`).
docs/experiments.md has the errors with and without.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fdda_addon.core.features import FEATURES_PER_JOINT, joint_features
from fdda_addon.core.partition import Partition
from fdda_addon.core.rig import STATIC_JOINT, Rig

from .deltas import FEATURES_PER_DELTA, NO_DELTAS, Deltas

FEATURES_PER_PAIR = 3


@dataclass(frozen=True)
class Inputs:
    """All features that networks see, F = 12 J + C + 3 Q + 3 D of them in a row, and which of them each network sees.

    First the J joints relative to their parents (`core.features`); then the C controls, each in its own unit; then Q
    points y of joints b as seen from joints a, P_a^-1 P_b y, in mesh units; then D deltas, in mesh units.

    Attributes:
        parents: (J,) int32, parent of each joint, -1 for a root.
        control_count: C.
        points: (M, 3) float32, points that move with joints, each in its joint's own frame, mesh units.
        point_joints: (M,) int64, their joints b.
        pair_references, pair_points: (Q,) int64, joints a and points y of each pair.
        columns: for each partition, (F_p,) int64 indices of the features that its network is offered.
        deltas: D of them.
    """

    parents: np.ndarray
    control_count: int
    points: np.ndarray
    point_joints: np.ndarray
    pair_references: np.ndarray
    pair_points: np.ndarray
    columns: tuple[np.ndarray, ...]
    deltas: Deltas = NO_DELTAS

    @property
    def joint_columns(self) -> int:
        """12 J, where the controls begin."""
        return len(self.parents) * FEATURES_PER_JOINT

    @property
    def own_columns(self) -> int:
        """12 J + C, where the pairs begin; they follow from what stands before them."""
        return self.joint_columns + self.control_count

    @property
    def first_delta(self) -> int:
        """12 J + C + 3 Q, where the deltas begin; they follow from the poses, too."""
        return self.own_columns + FEATURES_PER_PAIR * len(self.pair_points)

    @property
    def size(self) -> int:
        """F."""
        return self.first_delta + FEATURES_PER_DELTA * len(self.deltas)

    def are_lengths(self) -> np.ndarray:
        """(F,) bool, the features that are in the unit of length of mesh-object space."""
        number = np.arange(self.size)
        return (number >= self.own_columns) | ((number < self.joint_columns) & (number % 4 == 3))

    def with_deltas(self, deltas: Deltas, partitions: Sequence[Partition]) -> "Inputs":
        """The same, and each network is offered the deltas that its main joint sees."""
        columns = []
        for partition, own in zip(partitions, self.columns, strict=True):
            seen = np.flatnonzero(deltas.seen_from == partition.joint)
            columns.append(np.concatenate([own, *(_columns(self.first_delta, d, FEATURES_PER_DELTA) for d in seen)]))
        return replace(self, columns=tuple(columns), deltas=deltas)

    def features(
        self, pose_matrices: np.ndarray, rest_matrices: np.ndarray, controls: np.ndarray | None = None
    ) -> np.ndarray:
        """What there is to see of poses.

        Args:
            pose_matrices: (N, J, 4, 4), mesh-object space, mesh units.
            rest_matrices: (J, 4, 4), mesh-object space, mesh units.
            controls: (N, C) values; may be left out where C is 0.

        Returns:
            (N, F) float32.
        """
        values, shape = controls, (len(pose_matrices), self.control_count)
        if values is None:
            values = np.zeros((len(pose_matrices), 0))
        if values.shape != shape:
            raise ValueError(f"values of controls are {values.shape} and should be {shape}")
        joints = joint_features(pose_matrices, rest_matrices, self.parents).reshape(len(pose_matrices), -1)
        poses = pose_matrices.astype(np.float64)
        moved = poses[:, self.point_joints]
        there = np.einsum("nmab,mb->nma", moved[:, :, :3, :3], self.points) + moved[:, :, :3, 3]
        apart = there[:, self.pair_points] - poses[:, :, :3, 3][:, self.pair_references]
        seen = np.einsum("nqab,nqb->nqa", np.linalg.inv(poses[:, :, :3, :3])[:, self.pair_references], apart)
        parts = [joints, values.astype(np.float32), seen.reshape(len(poses), -1).astype(np.float32)]
        return np.concatenate([*parts, self.deltas.seen(pose_matrices)], axis=1)


def inputs_of_rig(rig: Rig, points: np.ndarray, partitions: Sequence[Partition]) -> Inputs:
    """Choose what the networks of a rig see; `points` and `partitions` as in `make_inputs`."""
    return make_inputs(rig.parents, points, partitions, len(rig.controls), unmoved_joints(rig))


def inputs_with_deltas(rig: Rig, partitions: Sequence[Partition], deltas: Deltas) -> Inputs:
    """Choose what the networks of a rig see, the middles of its partitions and some deltas among it."""
    return inputs_of_rig(rig, middles(rig, partitions), partitions).with_deltas(deltas, partitions)


def make_inputs(
    parents: np.ndarray,
    points: np.ndarray,
    partitions: Sequence[Partition],
    control_count: int = 0,
    unmoved: frozenset[int] = frozenset(),
) -> Inputs:
    """Choose what the networks see.

    A joint is seen from the main joint when every joint that moves one against the other influences the partition,
    and when there are at least two of these: one alone is seen relative to its parent already.

    Args:
        parents: (J,) parent index of each joint, -1 for a root.
        points: (J, S, 3) some of each joint, in its own frame, mesh units; `middles` makes one each of a rig.
        partitions: with their main joints, and the joints and controls that influence them.
        control_count: C.
        unmoved: joints that never move.
    """
    references, seen, columns = [], [], []
    each, first_control = points.shape[1], len(parents) * FEATURES_PER_JOINT
    for partition in partitions:
        own = [_columns(0, joint, FEATURES_PER_JOINT) for joint in partition.influencing]
        own += [_columns(first_control, control, 1) for control in partition.controls]
        for joint in range(len(parents)):
            between = joints_between(parents, partition.joint, joint) - unmoved
            if len(between) >= 2 and between <= set(partition.influencing):
                for point in range(joint * each, (joint + 1) * each):
                    own.append(_columns(first_control + control_count, len(seen), FEATURES_PER_PAIR))
                    references.append(partition.joint)
                    seen.append(point)
        columns.append(np.concatenate([*own, np.zeros(0, np.int64)]))
    return Inputs(
        parents,
        control_count,
        points.reshape(-1, 3).astype(np.float32),
        np.repeat(np.arange(len(parents)), each),
        np.array(references, np.int64),
        np.array(seen, np.int64),
        tuple(columns),
    )


def middles(rig: Rig, partitions: Sequence[Partition]) -> np.ndarray:
    """(J, 1, 3) float64 middle of each joint's partition, in its own frame, mesh units; 0 for one without vertices."""
    points = np.zeros((len(rig.joints), 1, 3))
    for partition in partitions:
        middle = np.append(rig.rest_positions[partition.vertices].mean(axis=0, dtype=np.float64), 1)
        points[partition.joint, 0] = (np.linalg.inv(rig.rest_matrices[partition.joint].astype(np.float64)) @ middle)[:3]
    return points


def unmoved_joints(rig: Rig) -> frozenset[int]:
    """The joints of a rig that never move: they influence nothing, and hide nothing that does."""
    return frozenset(number for number, joint in enumerate(rig.joints) if joint.name == STATIC_JOINT)


def _columns(start: int, number: int, width: int) -> np.ndarray:
    return start + number * width + np.arange(width)


def joints_between(parents: np.ndarray, first: int, second: int) -> set[int]:
    """The joints whose parent-relative transforms make up that of one joint relative to another.

    Where no joint is above both, these are all from either up to its root.
    """
    return set(_upwards(parents, first)) ^ set(_upwards(parents, second))


def _upwards(parents: np.ndarray, joint: int) -> list[int]:
    chain = []
    while joint >= 0:
        chain.append(joint)
        joint = int(parents[joint])
    return chain
