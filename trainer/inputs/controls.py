# SPDX-License-Identifier: GPL-3.0-or-later
"""The values of controls, as inputs."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from fdda_addon.core.formats.model import CONTROLS_INPUT
from fdda_addon.core.mathematics.partition import Partition
from fdda_addon.core.rig import Rig

from ..graph_builder import GraphBuilder
from .block import FeatureBlock, JointVectors, State, Vectors, add_scalar_vectors


@dataclass(frozen=True)
class ControlFeatures(FeatureBlock):
    """One feature for each of C controls, in its own unit."""

    name, is_direct = "controls", True
    count: int

    @classmethod
    def make(cls, rig: Rig, partitions: Sequence[Partition], state: State) -> Self:
        return cls(len(rig.controls))

    @property
    def length_mask(self) -> np.ndarray:
        return np.zeros(self.count, bool)

    def offered(self, partition: Partition) -> np.ndarray:
        return np.array(partition.controls, np.int64)

    def evaluate(self, pose_matrices: np.ndarray, controls: np.ndarray) -> np.ndarray:
        if controls.shape != (expected_shape := (len(pose_matrices), self.count)):
            raise ValueError(f"values of controls are {controls.shape} and should be {expected_shape}")
        return controls.astype(np.float32)

    def add_nodes(
        self, graph: GraphBuilder, is_needed: np.ndarray, joint_vectors: JointVectors
    ) -> tuple[Vectors, np.ndarray]:
        return add_scalar_vectors(graph, CONTROLS_INPUT, self.count), np.arange(self.count)
