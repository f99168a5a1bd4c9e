# SPDX-License-Identifier: GPL-3.0-or-later
"""Everything that a trained character is made of, ready to be exported or evaluated."""

from dataclasses import dataclass

import numpy as np

from fdda_addon.core.partition import Partition
from fdda_addon.core.rig import Rig

from .confidence import TrainingRange
from .data import PreparedPartition
from .inputs import Inputs
from .model import Network

ORTHOGONAL = 1e-5
"""Cosine of two columns of a pose matrix from which on it is sheared; float32 alone makes a tenth of it. Nearly locked
joints notice 3e-5: treating their bones as orthogonal lowers their confidence."""
BLOCK_POSES = 256


@dataclass(frozen=True)
class Deformation:
    """A trained character.

    Attributes:
        rig: with J joints and V vertices.
        partitions: P of them, with the prepared data and the network of each.
        inputs: what the networks see.
        training_range: features of the training poses.
        activation: of the networks.
        sheared: whether the columns of some recorded pose matrix are not orthogonal to each other.
    """

    rig: Rig
    partitions: tuple[Partition, ...]
    inputs: Inputs
    prepared: tuple[PreparedPartition, ...]
    networks: tuple[Network, ...]
    training_range: TrainingRange
    activation: str
    sheared: bool

    def standardization(self) -> tuple[np.ndarray, np.ndarray]:
        """(F,) float64 mean and scale of each feature; 0 and 1 where no network looks at it."""
        size = len(self.training_range.low)
        mean, scale = np.zeros(size), np.ones(size)
        for number, prepared in enumerate(self.prepared):
            columns = self.seen_columns(number)
            mean[columns], scale[columns] = prepared.feature_mean, prepared.feature_scale
        return mean, scale

    def seen_columns(self, partition: int) -> np.ndarray:
        """The features that a network sees, of those that it is offered, in its order."""
        return self.inputs.columns[partition][self.prepared[partition].columns]

    def turns(self) -> np.ndarray:
        """(H,) int64 ascending, the joints to whose turn matrices some partition is fitted."""
        fitted = np.unique(np.concatenate([prepared.fit.joints for prepared in self.prepared]))
        return fitted[fitted >= len(self.rig.parents)] - len(self.rig.parents)

    def shape_counts(self) -> list[int]:
        """K of each partition."""
        return [len(prepared.basis.shapes) for prepared in self.prepared]


def is_sheared(pose_matrices: np.ndarray) -> bool:
    """Whether some matrix has columns that are not orthogonal, to `ORTHOGONAL`; scaled ones may well be.

    Args:
        pose_matrices: (N, J, 4, 4).
    """
    for start in range(0, len(pose_matrices), BLOCK_POSES):
        axes = np.asarray(pose_matrices[start : start + BLOCK_POSES], np.float64)[:, :, :3, :3]
        lengths = np.linalg.norm(axes, axis=2)
        products = np.abs(axes.transpose(0, 1, 3, 2) @ axes)[:, :, [0, 0, 1], [1, 2, 2]]
        if (products > ORTHOGONAL * lengths[:, :, [0, 0, 1]] * lengths[:, :, [1, 2, 2]]).any():
            return True
    return False
