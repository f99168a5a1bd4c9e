# SPDX-License-Identifier: GPL-3.0-or-later
"""The transforms of joints and the values of controls, as inputs."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from fdda_addon.core.formats.model import CONTROLS_INPUT
from fdda_addon.core.mathematics.features import FEATURES_PER_JOINT, joint_features
from fdda_addon.core.mathematics.partition import Partition
from fdda_addon.core.rig import Rig

from ..graph_builder import GraphBuilder
from .block import MATRIX_COLUMNS, VECTOR_SIZE, FeatureBlock, JointVectors, State, Vectors, add_scalar_vectors


@dataclass(frozen=True)
class JointFeatures(FeatureBlock):
    """Twelve features for each of J joints (`mathematics.features`). Every fourth feature is a length in mesh units.

    Attributes:
        references: (J,) reference joint of each joint, -1 for mesh-object space.
        rest_matrices: (J, 4, 4) float32, mesh-object space, mesh units.
    """

    name, is_direct = "joints", True
    references: np.ndarray
    rest_matrices: np.ndarray

    @classmethod
    def make(cls, rig: Rig, partitions: Sequence[Partition], state: State) -> Self:
        return cls(rig.references, rig.rest_matrices)

    @property
    def length_mask(self) -> np.ndarray:
        return np.arange(FEATURES_PER_JOINT * len(self.references)) % MATRIX_COLUMNS == MATRIX_COLUMNS - 1

    def offered(self, partition: Partition) -> np.ndarray:
        joints = np.array(partition.influencing, np.int64)
        return (FEATURES_PER_JOINT * joints[:, None] + np.arange(FEATURES_PER_JOINT)).ravel()

    def evaluate(self, pose_matrices: np.ndarray, controls: np.ndarray) -> np.ndarray:
        return joint_features(pose_matrices, self.rest_matrices, self.references).reshape(len(pose_matrices), -1)

    def add_nodes(
        self, graph: GraphBuilder, is_needed: np.ndarray, joint_vectors: JointVectors
    ) -> tuple[Vectors, np.ndarray]:
        joints, position = joint_vectors.joints, np.full(len(is_needed), -1, np.int64)
        by_column = np.arange(FEATURES_PER_JOINT).reshape(VECTOR_SIZE, MATRIX_COLUMNS).T.ravel()
        position[(FEATURES_PER_JOINT * joints[:, None] + by_column).ravel()] = np.arange(
            FEATURES_PER_JOINT * len(joints)
        )
        # The zero vector belongs to them.
        return Vectors(joint_vectors.name, MATRIX_COLUMNS * len(joints) + 1), position


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
