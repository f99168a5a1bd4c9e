# SPDX-License-Identifier: GPL-3.0-or-later
"""What each network sees: its influencing joints relative to their parents, and where its neighbours are.

A smoothed surface depends on where the surface around it is. From the parent-relative transforms a network would have
to multiply its way to that; so it is also given the middle of the partitions around it, seen from its main joint.
docs/training.md has the errors with and without.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdda_addon.core.features import FEATURES_PER_JOINT, joint_features
from fdda_addon.core.partition import Partition
from fdda_addon.core.rig import Rig

FEATURES_PER_PAIR = 3


@dataclass(frozen=True)
class Inputs:
    """All features that networks see, F = 12 J + 3 Q of them in a row, and which of them each network sees.

    First the J joints relative to their parents (`core.features`); then Q points y of joints b as seen from joints a,
    P_a^-1 P_b y, in metres.

    Attributes:
        parents: (J,) int32, parent of each joint, -1 for a root.
        points: (M, 3) float32, points that move with joints, each in its joint's own frame, metres.
        point_joints: (M,) int64, their joints b.
        pair_references, pair_points: (Q,) int64, joints a and points y of each pair.
        columns: for each partition, (F_p,) int64 indices of the features that its network is offered.
    """

    parents: np.ndarray
    points: np.ndarray
    point_joints: np.ndarray
    pair_references: np.ndarray
    pair_points: np.ndarray
    columns: tuple[np.ndarray, ...]

    @property
    def joint_columns(self) -> int:
        """12 J, where the pairs begin."""
        return len(self.parents) * FEATURES_PER_JOINT

    def features(self, pose_matrices: np.ndarray, rest_matrices: np.ndarray) -> np.ndarray:
        """(N, J, 4, 4) poses, mesh-object space, metres, to (N, F) float32 features."""
        joints = joint_features(pose_matrices, rest_matrices, self.parents).reshape(len(pose_matrices), -1)
        poses = pose_matrices.astype(np.float64)
        moved = poses[:, self.point_joints]
        there = np.einsum("nmab,mb->nma", moved[:, :, :3, :3], self.points) + moved[:, :, :3, 3]
        apart = there[:, self.pair_points] - poses[:, :, :3, 3][:, self.pair_references]
        seen = np.einsum("nqab,nqb->nqa", np.linalg.inv(poses[:, :, :3, :3])[:, self.pair_references], apart)
        return np.concatenate([joints, seen.reshape(len(poses), -1).astype(np.float32)], axis=1)


def make_inputs(parents: np.ndarray, points: np.ndarray, partitions: Sequence[Partition]) -> Inputs:
    """Choose what the networks see.

    A joint is seen from the main joint when every joint that moves one against the other influences the partition,
    and when there are at least two of these: one alone is seen relative to its parent already.

    Args:
        parents: (J,) parent index of each joint, -1 for a root.
        points: (J, S, 3) some of each joint, in its own frame, metres; `middles` makes one each of a rig.
        partitions: with their main and influencing joints.
    """
    references, seen, columns = [], [], []
    each = points.shape[1]
    for partition in partitions:
        own = [_columns(0, joint, FEATURES_PER_JOINT) for joint in partition.influencing]
        for joint in range(len(parents)):
            between = joints_between(parents, partition.joint, joint)
            if len(between) >= 2 and between <= set(partition.influencing):
                for point in range(joint * each, (joint + 1) * each):
                    own.append(_columns(len(parents) * FEATURES_PER_JOINT, len(seen), FEATURES_PER_PAIR))
                    references.append(partition.joint)
                    seen.append(point)
        columns.append(np.concatenate([*own, np.zeros(0, np.int64)]))
    return Inputs(
        parents,
        points.reshape(-1, 3).astype(np.float32),
        np.repeat(np.arange(len(parents)), each),
        np.array(references, np.int64),
        np.array(seen, np.int64),
        tuple(columns),
    )


def middles(rig: Rig, partitions: Sequence[Partition]) -> np.ndarray:
    """(J, 1, 3) float64 middle of each joint's partition, in its own frame, metres; 0 for one without vertices."""
    points = np.zeros((len(rig.joints), 1, 3))
    for partition in partitions:
        middle = np.append(rig.rest_positions[partition.vertices].mean(axis=0, dtype=np.float64), 1)
        points[partition.joint, 0] = (np.linalg.inv(rig.rest_matrices[partition.joint].astype(np.float64)) @ middle)[:3]
    return points


def _columns(start: int, number: int, width: int) -> np.ndarray:
    return start + number * width + np.arange(width)


def joints_between(parents: np.ndarray, first: int, second: int) -> set[int]:
    """The joints whose parent-relative transforms make up that of one joint relative to another."""
    return set(_upwards(parents, first)) ^ set(_upwards(parents, second))


def _upwards(parents: np.ndarray, joint: int) -> list[int]:
    chain = []
    while joint >= 0:
        chain.append(joint)
        joint = int(parents[joint])
    return chain
