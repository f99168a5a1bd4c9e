# SPDX-License-Identifier: GPL-3.0-or-later
"""What each network sees: its influencing joints relative to their parents, and relative to the main joint.

A smoothed surface is nearly linear in the skin matrices of the joints around it, taken in the frame of the main joint.
Those are products of the parent-relative transforms along the way from one joint to the other; a network that is given
them need not learn to multiply. docs/training.md has the errors with and without.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdda_addon.core.features import FEATURES_PER_JOINT, relative_features
from fdda_addon.core.partition import Partition


@dataclass(frozen=True)
class InputRows:
    """The transforms that the networks see, twelve numbers each; the first J are the joints relative to their parents.

    Attributes:
        references: (R,) int64, index of the joint that a transform is relative to, -1 for mesh-object space.
        joints: (R,) int64, index of the joint itself.
        rows: for each partition, the indices of its transforms.
    """

    references: np.ndarray
    joints: np.ndarray
    rows: tuple[np.ndarray, ...]

    def features(self, pose_matrices: np.ndarray, rest_matrices: np.ndarray) -> np.ndarray:
        """(N, J, 4, 4) poses to (N, R, 12) float32 features (`core.features.relative_features`)."""
        return relative_features(pose_matrices, rest_matrices, self.references, self.joints)

    def columns(self, partition: int) -> np.ndarray:
        """Where the features of a partition stand among all R * 12, in the order that its network sees."""
        return (self.rows[partition][:, None] * FEATURES_PER_JOINT + np.arange(FEATURES_PER_JOINT)).ravel()


def make_input_rows(parents: np.ndarray, partitions: Sequence[Partition]) -> InputRows:
    """Choose the transforms.

    A joint is seen relative to the main joint when every joint that moves one against the other influences the
    partition, and when there are at least two of these: one alone is seen relative to its parent already.

    Args:
        parents: (J,) parent index of each joint, -1 for a root.
        partitions: with their main and influencing joints.
    """
    references, joints, rows = list(parents), list(range(len(parents))), []
    for partition in partitions:
        own = list(partition.influencing)
        for joint in range(len(parents)):
            between = _between(parents, partition.joint, joint)
            if len(between) >= 2 and between <= set(partition.influencing):
                own.append(len(joints))
                references.append(partition.joint)
                joints.append(joint)
        rows.append(np.array(own, np.int64))
    return InputRows(np.array(references, np.int64), np.array(joints, np.int64), tuple(rows))


def _between(parents: np.ndarray, first: int, second: int) -> set[int]:
    """The joints whose parent-relative transforms make up that of one joint relative to another."""
    return set(_upwards(parents, first)) ^ set(_upwards(parents, second))


def _upwards(parents: np.ndarray, joint: int) -> list[int]:
    chain = []
    while joint >= 0:
        chain.append(joint)
        joint = int(parents[joint])
    return chain
