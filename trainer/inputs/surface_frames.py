# SPDX-License-Identifier: GPL-3.0-or-later
"""Surface frames: tangents and normals of the smoothed surface at chosen vertices, as inputs of the networks.

Delta mush smooths the skinned surface and adds the detail of the rest pose, a delta for each vertex, in the local
frame of the smoothed surface (Mancewicz and others, Delta Mush, 2014; Blender's Corrective Smooth). Where the surface
folds, a small rotation of a joint flips that frame, and a network that takes only joints as inputs cannot follow.
Smoothed linear skinning is linear in the pose matrices, so the frame of a few vertices is cheap to compute. Each
surface frame is a weighted sum of tangents and normals of the face corners at a vertex; `surface_frame_fit` fits the
weights to the recording. docs/experiments.md compares the errors with and without them.
"""

from dataclasses import dataclass

import numpy as np

from fdda_addon.core.rig import Rig

from ..blocks import BLOCK_ELEMENTS

FEATURES_PER_SURFACE_FRAME = 3
MIN_SQUARED_LENGTH = 1e-18
"""Added to squared lengths before a division, so that a joint that is scaled to zero gives finite values."""
MAX_JOINT_ENTRIES = 1 << 12
"""Maximum of joints times surface frames. Each evaluation reads one value of each joint for each tangent."""


@dataclass(frozen=True)
class SurfaceFrameFeatures:
    """D surface frames at vertices with up to K face corners.

    With a and b the edges of the smoothed surface from a vertex to its predecessor and successor in a face, the corner
    has the tangents a + b and b - a; their cross product is along the normal. Each vector v enters as
    v / sqrt(|v|^2 + epsilon^2), of length 1 unless the corner has degenerated.

    Attributes:
        vertices: (D,) int64.
        main_joints: (D,) int64, main joint of each vertex's partition; the features are in its space.
        tangents: (2, D, K, 4 J) float64, mesh units. Their product with the columns of all pose matrices, stacked to
            (4 J, 3), is the tangents in mesh-object space. Padded with 0.
        epsilons: (3, D, K) float64, above 0: of the tangents in mesh units, of the normal in square mesh units.
        lengths: (3, D, K) float64, mesh units, weights of the tangents and of the normal in the sum. Padded with 0.
    """

    vertices: np.ndarray
    main_joints: np.ndarray
    tangents: np.ndarray
    epsilons: np.ndarray
    lengths: np.ndarray

    def __len__(self) -> int:
        return len(self.vertices)

    def fits(self, rig: Rig) -> bool:
        """Return whether indices and sizes are possible for a rig."""
        joint_count, vertex_count = len(rig.joints), rig.vertex_count
        has_valid_indices = (
            self.main_joints.max(initial=0) < joint_count and self.vertices.max(initial=0) < vertex_count
        )
        has_valid_size = len(self) * joint_count <= MAX_JOINT_ENTRIES
        return has_valid_indices and has_valid_size and (not len(self) or self.tangents.shape[3] == 4 * joint_count)

    def subset(self, mask: np.ndarray) -> "SurfaceFrameFeatures":
        """Return the surface frames of a (D,) bool mask, without the corners that none of them uses."""
        is_used = (self.lengths[:, mask] != 0).any(axis=(0, 1))
        corner_arrays = (array[:, mask][:, :, is_used] for array in (self.tangents, self.epsilons, self.lengths))
        return SurfaceFrameFeatures(self.vertices[mask], self.main_joints[mask], *corner_arrays)

    def evaluate(self, pose_matrices: np.ndarray) -> np.ndarray:
        """Compute the features along the axes of the main joints; a uniform scale of the character cancels out.

        Args:
            pose_matrices: (N, J, 4, 4), mesh-object space, mesh units.

        Returns:
            (N, 3 D) float32, mesh units.
        """
        frame_count = len(self)
        features = np.empty((len(pose_matrices), FEATURES_PER_SURFACE_FRAME * frame_count), np.float32)
        step = max(1, BLOCK_ELEMENTS // max(1, 3 * self.lengths.size))
        for start in range(0, len(features) if frame_count else 0, step):
            poses = pose_matrices[start : start + step].astype(np.float64)
            frame_sums = np.einsum("nfdkc,fdk->ndc", self.compute_corner_vectors(poses), self.lengths)
            axes = poses[:, self.main_joints, :3, :3]
            axes /= np.sqrt((axes**2).sum(axis=2, keepdims=True) + MIN_SQUARED_LENGTH)
            features[start : start + step] = np.einsum("ndab,nda->ndb", axes, frame_sums).reshape(len(poses), -1)
        return features

    def compute_corner_vectors(self, pose_matrices: np.ndarray) -> np.ndarray:
        """Compute the tangents and normals of all corners.

        Args:
            pose_matrices: (N, J, 4, 4), mesh-object space, mesh units.

        Returns:
            (N, 3, D, K, 3) float64, mesh-object space, no unit.
        """
        columns = pose_matrices[:, :, :3].astype(np.float64).swapaxes(2, 3).reshape(len(pose_matrices), -1, 3)
        size = self.tangents.shape
        tangents = (self.tangents.reshape(-1, size[3]) @ columns).reshape(len(columns), *size[:3], 3)
        vectors = np.append(tangents, np.cross(tangents[:, :1], tangents[:, 1:]), axis=1)
        return vectors / np.sqrt((vectors**2).sum(axis=4) + self.epsilons**2)[..., None]


NO_SURFACE_FRAMES = SurfaceFrameFeatures(
    *(np.zeros(0, np.int64) for _ in range(2)),
    np.zeros((2, 0, 1, 0)),
    *(np.zeros((3, 0, 1)) for _ in range(2)),
)
