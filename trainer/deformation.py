# SPDX-License-Identifier: GPL-3.0-or-later
"""Everything that a trained character is made of, ready to be exported or evaluated."""

from dataclasses import dataclass

import numpy as np

from fdda_addon.core.partition import Partition
from fdda_addon.core.rig import Rig

from .data import PreparedPartition
from .inputs import Inputs
from .model import Network
from .trust import TrustRange


@dataclass(frozen=True)
class Deformation:
    """A trained character.

    Attributes:
        rig: with J joints and V vertices.
        partitions: P of them, with the prepared data and the network of each.
        inputs: what the networks see.
        trust: range of the training poses.
        activation: of the networks.
    """

    rig: Rig
    partitions: tuple[Partition, ...]
    inputs: Inputs
    prepared: tuple[PreparedPartition, ...]
    networks: tuple[Network, ...]
    trust: TrustRange
    activation: str

    def standardisation(self) -> tuple[np.ndarray, np.ndarray]:
        """(F,) float64 mean and scale of each feature; 0 and 1 where no network looks at it."""
        size = len(self.trust.low)
        mean, scale = np.zeros(size), np.ones(size)
        for number, prepared in enumerate(self.prepared):
            columns = self.seen_columns(number)
            mean[columns], scale[columns] = prepared.feature_mean, prepared.feature_scale
        return mean, scale

    def seen_columns(self, partition: int) -> np.ndarray:
        """The features that a network sees, of those that it is offered, in its order."""
        return self.inputs.columns[partition][self.prepared[partition].columns]

    def shape_counts(self) -> list[int]:
        """K of each partition."""
        return [len(prepared.basis.shapes) for prepared in self.prepared]
