# SPDX-License-Identifier: GPL-3.0-or-later
"""The rotations of joints as three numbers each, in place of the nine elements of their matrices, as inputs."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from fdda_addon.core.mathematics.features import FEATURES_PER_JOINT, joint_features
from fdda_addon.core.mathematics.partition import Partition
from fdda_addon.core.recording.skinned import SkinnedRecording
from fdda_addon.core.rig import Rig

from ..config import TrainingConfig
from ..data.split import Split
from ..graph_builder import GraphBuilder
from .block import MATRIX_COLUMNS, VECTOR_SIZE, FeatureBlock, JointVectors, State, Vectors

MAX_SCALE_OR_SHEAR = 1e-3
"""A joint has a rotation if no element of R^T R differs from the identity by more, in any training pose."""
MIN_TRACE = -0.9
"""Smallest trace of a rotation, at 162 degrees. Beyond this angle the three numbers return to zero, so that they are
continuous at 180 degrees, where the axis changes its sign. Joints that rotate further in training keep the elements."""
ROTATION_ELEMENTS = np.flatnonzero(np.arange(FEATURES_PER_JOINT) % MATRIX_COLUMNS < VECTOR_SIZE)
"""Indices of the elements of a rotation among the features of a joint."""


def _differences() -> np.ndarray:
    """Return the (12, 4) matrix whose product with the features of a joint is its R - R^T, as a vector, and its trace.

    The vector of a rotation by an angle a is 2 sin a times the axis, and the trace is 1 + 2 cos a.
    """
    matrix, element = np.zeros((FEATURES_PER_JOINT, VECTOR_SIZE + 1)), np.arange(FEATURES_PER_JOINT).reshape(3, 4)
    for axis in range(VECTOR_SIZE):
        first, second = (axis + 1) % VECTOR_SIZE, (axis + 2) % VECTOR_SIZE
        matrix[element[second, first], axis], matrix[element[first, second], axis] = 1, -1
        matrix[element[axis, axis], VECTOR_SIZE] = 1
    return matrix


@dataclass(frozen=True)
class RotationFeatures(FeatureBlock):
    """Three features for each of R joints: the axis of its rotation times 2 sin(a / 2), a the angle; no unit.

    The rotation is relative to the reference joint and the rest pose. A network needs fewer weights for them, and
    joints without scale rotate by nothing else. The elements of the rotations remain what the confidence depends on.

    Attributes:
        references: (J,) reference joint of each joint, -1 for mesh-object space.
        rest_matrices: (J, 4, 4) float32, mesh-object space, mesh units.
        joints: (R,) int64, ascending, joints that influence a partition.
    """

    name = "rotations"
    references: np.ndarray
    rest_matrices: np.ndarray
    joints: np.ndarray

    @classmethod
    def fit(cls, recording: SkinnedRecording, split: Split, config: TrainingConfig) -> State:
        rig, matrices = recording.rig, np.array(recording.pose_matrices[split.training])
        features = joint_features(matrices, rig.rest_matrices, rig.references)
        rotations = features.reshape(*features.shape[:2], VECTOR_SIZE, MATRIX_COLUMNS)[..., :VECTOR_SIZE]
        errors = np.abs(rotations.swapaxes(2, 3) @ rotations - np.eye(VECTOR_SIZE, dtype=np.float32))
        is_rotation = (errors.max(axis=(0, 2, 3)) <= MAX_SCALE_OR_SHEAR) & (
            np.trace(rotations, axis1=2, axis2=3).min(axis=0) >= MIN_TRACE
        )
        influencing = sorted({joint for partition in recording.partitions for joint in partition.influencing})
        joints = np.array([joint for joint in influencing if is_rotation[joint]], np.int64)
        return {"joints": joints} if len(joints) else {}

    @classmethod
    def check_state(cls, state: State, rig: Rig) -> None:
        if not state:
            return
        joints = state.get("joints")
        if set(state) != {"joints"} or joints.dtype != np.int64 or joints.ndim != 1:
            raise ValueError("arrays of rotations contradict each other")
        if joints.min(initial=0) < 0 or joints.max(initial=0) >= len(rig.joints) or (np.diff(joints) <= 0).any():
            raise ValueError("rotations are of another rig")

    @classmethod
    def make(cls, rig: Rig, partitions: Sequence[Partition], state: State) -> Self:
        return cls(rig.references, rig.rest_matrices, state.get("joints", np.zeros(0, np.int64)))

    @property
    def length_mask(self) -> np.ndarray:
        return np.zeros(VECTOR_SIZE * len(self.joints), bool)

    @property
    def replaced(self) -> np.ndarray:
        return (FEATURES_PER_JOINT * self.joints[:, None] + ROTATION_ELEMENTS).ravel()

    def offered(self, partition: Partition) -> np.ndarray:
        indices = np.flatnonzero(np.isin(self.joints, partition.influencing))
        return (VECTOR_SIZE * indices[:, None] + np.arange(VECTOR_SIZE)).ravel()

    def evaluate(self, pose_matrices: np.ndarray, controls: np.ndarray) -> np.ndarray:
        features = joint_features(pose_matrices, self.rest_matrices, self.references)[:, self.joints]
        differences = features.astype(np.float64) @ _differences()
        squares = np.maximum(1 + differences[..., VECTOR_SIZE:], 1 + MIN_TRACE)
        return (differences[..., :VECTOR_SIZE] / np.sqrt(squares)).reshape(len(features), -1).astype(np.float32)

    def add_nodes(
        self, graph: GraphBuilder, is_needed: np.ndarray, joint_vectors: JointVectors
    ) -> tuple[Vectors, np.ndarray]:
        # The confidence depends on all joints that influence a partition, so their vectors are there.
        columns = graph.integers("rotated_joints", joint_vectors.columns(self.joints))
        features = graph.add("Gather", [joint_vectors.name, columns], "columns_of_rotations", axis=1)
        features = graph.reshape(features, [0, len(self.joints), FEATURES_PER_JOINT], "features_of_rotations")
        by_column = np.arange(FEATURES_PER_JOINT).reshape(VECTOR_SIZE, MATRIX_COLUMNS).T.ravel()
        differences = graph.floats("rotation_differences", _differences()[by_column])
        differences = graph.add("MatMul", [features, differences], "axes_and_traces")
        axes, traces = graph.split(differences, [VECTOR_SIZE, 1], ["rotation_axes", "rotation_traces"], axis=2)
        squares = graph.add("Add", [traces, graph.floats("one", np.ones(1))], "rotation_squares")
        squares = graph.add("Max", [squares, graph.floats("least_square", np.full(1, 1 + MIN_TRACE))], "safe_squares")
        name = graph.add("Div", [axes, graph.add("Sqrt", [squares], "rotation_divisors")], "rotation_features")
        return Vectors(name, len(self.joints)), np.arange(len(is_needed))
