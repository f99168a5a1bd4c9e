# SPDX-License-Identifier: GPL-3.0-or-later
"""The input features of the networks: the features of all blocks in a row."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Self

import numpy as np

from fdda_addon.core.mathematics.partition import Partition
from fdda_addon.core.recording.skinned import SkinnedRecording
from fdda_addon.core.rig import Rig

from ..config import TrainingConfig
from ..data.split import Split
from .block import FeatureBlock, State
from .joints import ControlFeatures, JointFeatures
from .rotations import RotationFeatures
from .surface_frames import SurfaceFrameFeatures

BLOCKS: tuple[type[FeatureBlock], ...] = (JointFeatures, ControlFeatures, SurfaceFrameFeatures, RotationFeatures)
"""All blocks, in the order of their features. The features of joints come first, and direct blocks before others."""


@dataclass(frozen=True)
class NetworkInputs:
    """All F input features, and the features of each network.

    Attributes:
        blocks: one block of each type, in the order of `BLOCKS`.
        columns: for each partition, (F_p,) int64 indices of the features that are offered to its network.
        states: state of each block that has one, by its name; a checkpoint stores them.
    """

    blocks: tuple[FeatureBlock, ...]
    columns: tuple[np.ndarray, ...]
    states: dict[str, State] = field(default_factory=dict)

    @classmethod
    def of(
        cls, blocks: Sequence[FeatureBlock], partitions: Sequence[Partition], states: dict[str, State] | None = None
    ) -> Self:
        """Offer the features of blocks to the networks of partitions."""
        starts, replaced = _starts(blocks)[:-1], np.concatenate([block.replaced for block in blocks])
        columns = (
            np.concatenate([start + block.offered(partition) for start, block in zip(starts, blocks, strict=True)])
            for partition in partitions
        )
        return cls(tuple(blocks), tuple(c[~np.isin(c, replaced)] for c in columns), states or {})

    @property
    def block_slices(self) -> list[slice]:
        """The features of each block."""
        return [slice(*limits) for limits in pairwise(_starts(self.blocks))]

    def length_mask(self) -> np.ndarray:
        """Return (F,) bool, which features are lengths in mesh units."""
        return np.concatenate([block.length_mask for block in self.blocks])

    def compute_features(self, pose_matrices: np.ndarray, controls: np.ndarray) -> np.ndarray:
        """Compute the (N, F) float32 features of poses; arguments as in `FeatureBlock.evaluate`."""
        return np.concatenate([block.evaluate(pose_matrices, controls) for block in self.blocks], axis=1)


def _starts(blocks: Sequence[FeatureBlock]) -> list[int]:
    return np.cumsum([0, *(len(block.length_mask) for block in blocks)]).tolist()


def fit_inputs(recording: SkinnedRecording, split: Split, config: TrainingConfig) -> dict[str, State]:
    """Fit all blocks to a recording; returns the state of each block by its name."""
    return {block.name: block.fit(recording, split, config) for block in BLOCKS}


def make_inputs(rig: Rig, partitions: Sequence[Partition], states: dict[str, State] | None = None) -> NetworkInputs:
    """Make the inputs of a rig's networks from the states of blocks; a block without a state has not been fitted."""
    states = states or {}
    blocks = [block.make(rig, partitions, states.get(block.name, {})) for block in BLOCKS]
    return NetworkInputs.of(blocks, partitions, states)


def check_states(states: dict[str, State], rig: Rig) -> None:
    """Check the states of a checkpoint.

    Raises:
        ValueError: a state is of an unknown block, or a block cannot be made from its state.
    """
    if unknown := states.keys() - {block.name for block in BLOCKS}:
        raise ValueError(f"unknown inputs {', '.join(sorted(unknown))}")
    for block in BLOCKS:
        block.check_state(states.get(block.name, {}), rig)
