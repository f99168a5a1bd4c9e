# SPDX-License-Identifier: GPL-3.0-or-later
"""Tangents and normals of the smoothed surface at chosen vertices."""

from dataclasses import dataclass
from typing import Self

import numpy as np

MAX_JOINT_ENTRIES = 1 << 12
"""Maximum of joints times surface frames. Each evaluation reads one value of each joint for each tangent."""


@dataclass(frozen=True)
class SurfaceFrames:
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

    def subset(self, mask: np.ndarray) -> Self:
        """Return the surface frames of a (D,) bool mask, without the corners that none of them uses."""
        is_used = (self.lengths[:, mask] != 0).any(axis=(0, 1))
        corner_arrays = (array[:, mask][:, :, is_used] for array in (self.tangents, self.epsilons, self.lengths))
        return type(self)(self.vertices[mask], self.main_joints[mask], *corner_arrays)

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


NO_SURFACE_FRAMES = SurfaceFrames(
    *(np.zeros(0, np.int64) for _ in range(2)), np.zeros((2, 0, 1, 0)), *(np.zeros((3, 0, 1)) for _ in range(2))
)
