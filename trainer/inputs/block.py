# SPDX-License-Identifier: GPL-3.0-or-later
"""The protocol of input features. docs/development.md, A new input, explains how to add a block."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from fdda_addon.core.mathematics.partition import Partition
from fdda_addon.core.recording.skinned import SkinnedRecording
from fdda_addon.core.rig import Rig

from ..config import TrainingConfig
from ..data.split import Split
from ..graph_builder import GraphBuilder

State = dict[str, np.ndarray]
VECTOR_SIZE = 3
"""Number of elements of a vector. The graph gathers three features at a time, as one vector."""
MATRIX_COLUMNS = 4
"""Number of columns of an affine matrix."""


@dataclass(frozen=True)
class Vectors:
    """B vectors in the graph: the name of a value (N, B, 3), and B."""

    name: str
    count: int


@dataclass(frozen=True)
class JointVectors:
    """The features of joints in the graph: the four columns of the matrix F_j of each joint (`mathematics.features`).

    Attributes:
        name: name of the (N, 4 B + 1, 3) vectors: the columns of B joints, and a zero vector.
        joints: (B,) int64, ascending.
    """

    name: str
    joints: np.ndarray

    def columns(self, joints: np.ndarray) -> np.ndarray:
        """Return the (n, 4) indices of the columns of n of the B joints."""
        return MATRIX_COLUMNS * np.searchsorted(self.joints, joints)[:, None] + np.arange(MATRIX_COLUMNS)


class FeatureBlock(ABC):
    """A group of F input features, computed from the pose matrices and the controls of a pose.

    Attributes:
        name: name of the block in checkpoints.
        is_direct: whether the confidence depends on the features. It depends on those of joints and controls only.
    """

    name: ClassVar[str]
    is_direct: ClassVar[bool] = False

    @classmethod
    def fit(cls, recording: SkinnedRecording, split: Split, config: TrainingConfig) -> State:
        """Fit the block to a recording; returns its state, arrays that a checkpoint stores."""
        return {}

    @classmethod
    def check_state(cls, state: State, rig: Rig) -> None:
        """Check a state that was read from a file: empty, or arrays of int64 or floats with finite values.

        Raises:
            ValueError: the block cannot be made from it.
        """
        if state:
            raise ValueError(f"{cls.name} have no state")

    @classmethod
    @abstractmethod
    def make(cls, rig: Rig, partitions: Sequence[Partition], state: State) -> Self:
        """Make the block of a rig with partitions, from a state that `fit` returned."""

    @property
    @abstractmethod
    def length_mask(self) -> np.ndarray:
        """(F,) bool, which features are lengths in mesh units. Other features have no unit."""

    @abstractmethod
    def offered(self, partition: Partition) -> np.ndarray:
        """Return indices of the features that are offered to the network of a partition."""

    @property
    def replaced(self) -> np.ndarray:
        """Indices of the features of joints that this block replaces: no network takes them."""
        return np.zeros(0, np.int64)

    @abstractmethod
    def evaluate(self, pose_matrices: np.ndarray, controls: np.ndarray) -> np.ndarray:
        """Compute the features: the reference, with which the nodes of the graph are compared.

        Args:
            pose_matrices: (N, J, 4, 4), mesh-object space, mesh units.
            controls: (N, C) values.

        Returns:
            (N, F) float32.
        """

    @abstractmethod
    def add_nodes(
        self, graph: GraphBuilder, is_needed: np.ndarray, joint_vectors: JointVectors
    ) -> tuple[Vectors, np.ndarray]:
        """Add the nodes that compute the features; not called for a block without features.

        Args:
            graph: graph with the inputs `POSE_INPUT`, (N, J, 4, 4), and `CONTROLS_INPUT`, (N, C).
            is_needed: (F,) bool, the features that a network, or another part of the graph, reads. The nodes may
                compute more.
            joint_vectors: the features of all joints that a network, or another part of the graph, depends on.

        Returns:
            The vectors, and (F,) int64, the index of each feature among their 3 B elements, -1 for a feature that is
            not computed.
        """

    @property
    def log_text(self) -> str:
        """A sentence for the log about what was fitted; empty for nothing to tell."""
        return ""


def add_scalar_vectors(graph: GraphBuilder, scalars: str, count: int) -> Vectors:
    """Add `count` vectors for (N, count) scalars: element i of all their elements, in a row, is scalar i."""
    repeated = graph.add("Concat", [scalars] * VECTOR_SIZE, f"{scalars}_repeated", axis=1)
    return Vectors(graph.reshape(repeated, [0, count, VECTOR_SIZE], f"{scalars}_vectors"), count)
