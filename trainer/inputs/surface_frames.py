# SPDX-License-Identifier: GPL-3.0-or-later
"""Surface frames: tangents and normals of the smoothed surface at chosen vertices, as inputs of the networks.

Delta mush smooths the skinned surface and adds the detail of the rest pose, a delta for each vertex, in the local
frame of the smoothed surface (Mancewicz and others, Delta Mush, 2014; Blender's Corrective Smooth). Where the surface
folds, a small rotation of a joint flips that frame, and a network that takes only joints as inputs cannot follow.
Smoothed linear skinning is linear in the pose matrices, so the frame of a few vertices is cheap to compute. Each
surface frame is a weighted sum of tangents and normals of the face corners at a vertex; `surface_frame_fit` fits the
weights to the recording. docs/experiments.md compares the errors with and without them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from fdda_addon.core.formats.model import POSE_INPUT
from fdda_addon.core.mathematics.blocks import block_slices
from fdda_addon.core.mathematics.partition import Partition
from fdda_addon.core.recording.skinned import SkinnedRecording
from fdda_addon.core.rig import Rig

from ..config import TrainingConfig
from ..data.split import Split
from ..graph_builder import GraphBuilder
from .block import VECTOR_SIZE, FeatureBlock, JointVectors, State, Vectors
from .smoothed_surface import MAX_JOINT_ENTRIES, NO_SURFACE_FRAMES, SurfaceFrames
from .surface_frame_fit import select_surface_frames

MATRIX_ROWS = 4
"""Number of rows of a pose matrix. The last row has no effect; removing it would take longer than computing with it."""
MIN_SQUARED_LENGTH = 1e-18
"""Added to squared lengths before a division, so that a joint that is scaled to zero gives finite values."""


@dataclass(frozen=True)
class SurfaceFrameFeatures(SurfaceFrames, FeatureBlock):
    """Three features for each of D surface frames: their sum in the space of the main joint, mesh units."""

    name = "surface_frames"

    @classmethod
    def fit(cls, recording: SkinnedRecording, split: Split, config: TrainingConfig) -> State:
        surface_frames = select_surface_frames(recording, split, config.detail_mm)
        return dict(vars(surface_frames)) if len(surface_frames) else {}

    @classmethod
    def check_state(cls, state: State, rig: Rig) -> None:
        if not state:
            return
        joint_count, (count, corner_count) = len(rig.joints), state["lengths"].shape[1:]
        expected = {
            **dict.fromkeys(("vertices", "main_joints"), (np.dtype(np.int64), (count,))),
            **dict.fromkeys(("epsilons", "lengths"), (np.dtype(np.float64), (3, count, corner_count))),
            "tangents": (np.dtype(np.float64), (2, count, corner_count, 4 * joint_count)),
        }
        types = {name: (array.dtype, array.shape) for name, array in state.items()}
        if types != expected or count * joint_count > MAX_JOINT_ENTRIES:
            raise ValueError("arrays of surface frames contradict each other")
        for indices, limit in ((state["vertices"], rig.vertex_count), (state["main_joints"], joint_count)):
            if indices.min(initial=0) < 0 or indices.max(initial=0) >= limit:
                raise ValueError("surface frames are of another rig")
        if not (state["epsilons"] > 0).all():
            raise ValueError("surface frames have epsilons of 0")

    @classmethod
    def make(cls, rig: Rig, partitions: Sequence[Partition], state: State) -> Self:
        return cls(**(state or vars(NO_SURFACE_FRAMES)))

    @property
    def length_mask(self) -> np.ndarray:
        return np.ones(VECTOR_SIZE * len(self), bool)

    def offered(self, partition: Partition) -> np.ndarray:
        frames = np.flatnonzero(self.main_joints == partition.joint)
        return (VECTOR_SIZE * frames[:, None] + np.arange(VECTOR_SIZE)).ravel()

    @property
    def log_text(self) -> str:
        count = len(self)
        return f"The rig smooths: networks take surface frames of {count} vertices as inputs." if count else ""

    def evaluate(self, pose_matrices: np.ndarray, controls: np.ndarray | None = None) -> np.ndarray:
        """Compute the features along the axes of the main joints; a uniform scale of the character cancels out."""
        features = np.empty((len(pose_matrices), VECTOR_SIZE * len(self)), np.float32)
        for block in block_slices(len(features) if len(self) else 0, 3 * self.lengths.size):
            poses = pose_matrices[block].astype(np.float64)
            frame_sums = np.einsum("nfdkc,fdk->ndc", self.compute_corner_vectors(poses), self.lengths)
            axes = poses[:, self.main_joints, :3, :3]
            axes /= np.sqrt((axes**2).sum(axis=2, keepdims=True) + MIN_SQUARED_LENGTH)
            features[block] = np.einsum("ndab,nda->ndb", axes, frame_sums).reshape(len(poses), -1)
        return features

    def add_nodes(
        self, graph: GraphBuilder, is_needed: np.ndarray, joint_vectors: JointVectors
    ) -> tuple[Vectors, np.ndarray]:
        (frame_count, corner_count), column_count = self.lengths.shape[1:], self.tangents.shape[3]
        # The corners come before the frames, so that a sum over the corners adds contiguous rows.
        tangent_weights, epsilons, lengths = (
            array.swapaxes(1, 2) for array in (self.tangents, self.epsilons, self.lengths)
        )
        poses_by_row = graph.add("Transpose", [POSE_INPUT], "poses_by_row", perm=[0, 2, 1, 3])
        pose_columns = graph.reshape(poses_by_row, [0, MATRIX_ROWS, column_count], "pose_columns")
        tangents = []
        for kind, weights in zip(("first", "second"), tangent_weights, strict=True):
            of_poses = graph.floats(f"{kind}_of_poses", weights.reshape(-1, column_count).T)
            tangents.append(graph.add("MatMul", [pose_columns, of_poses], f"{kind}_tangents"))
        # a x b = (a_y b_z, a_z b_x, a_x b_y) - (a_z b_y, a_x b_z, a_y b_x)
        permuted_tangents = [
            graph.add("Gather", [tangent, graph.integers(f"{tangent}_axes", axes)], f"{tangent}_permuted", axis=1)
            for tangent, axes in zip(tangents, ([1, 2, 0, 2, 0, 1], [2, 0, 1, 1, 2, 0]), strict=True)
        ]
        cross_signs = graph.floats(
            "cross_signs", np.pad(np.hstack([np.eye(3), -np.eye(3)]), ((0, MATRIX_ROWS - 3), (0, 0)))
        )
        normals = graph.add("MatMul", [cross_signs, graph.add("Mul", permuted_tangents, "cross_terms")], "crossed")
        # The same nodes normalize the corner vectors and the axes of the joints.
        vectors = graph.add("Concat", [*tangents, normals, pose_columns], "corner_vectors", axis=2)
        squared_epsilons = np.append(epsilons.ravel() ** 2, np.full(column_count, MIN_SQUARED_LENGTH))
        squared_lengths = graph.add("Mul", [vectors, vectors], "vectors_squared")
        # The last row of a tangent is masked: it is not exactly 0, because skin weights sum to 1 up to rounding.
        row_mask = graph.floats("rows_in_space", [[1, 1, 1, 0]])
        squared_lengths = graph.add("MatMul", [row_mask, squared_lengths], "vector_sums")
        squared_epsilons = graph.floats("least_squares", squared_epsilons)
        safe_squared_lengths = graph.add("Add", [squared_lengths, squared_epsilons], "vectors_safe")
        factors = graph.floats("vector_lengths", np.append(lengths.ravel(), np.ones(column_count)))
        vector_lengths = graph.add("Sqrt", [safe_squared_lengths], "lengths_of_vectors")
        factors = graph.add("Div", [factors, vector_lengths], "vector_factors")
        vectors = graph.add("Mul", [vectors, factors], "scaled_vectors")
        frame_terms, axes = graph.split(vectors, [lengths.size, column_count], ["surface_frame_terms", "axes"], axis=2)
        shape = [0, MATRIX_ROWS, len(lengths) * corner_count, frame_count]
        frame_terms = graph.reshape(frame_terms, shape, "terms_by_surface_frame")
        axis = graph.integers("kinds_and_corners", [2])
        frame_sums = graph.add("ReduceSum", [frame_terms, axis], "surface_frames", keepdims=0)
        # Gathering the main joint's products last is faster than gathering its axes before the product.
        axes = graph.add("Transpose", [axes], "axes_by_row", perm=[0, 2, 1])
        projected_sums = graph.add("MatMul", [axes, frame_sums], "along_axes")
        projected_sums = graph.reshape(projected_sums, [0, column_count * frame_count], "along_axes_in_row")
        main_joint_rows = frame_count * (4 * self.main_joints[:, None] + np.arange(3)) + np.arange(frame_count)[:, None]
        main_joint_rows = graph.integers("main_joint_axes", main_joint_rows)
        name = graph.add("Gather", [projected_sums, main_joint_rows], "surface_frame_features", axis=1)
        return Vectors(name, frame_count), np.arange(len(is_needed))
