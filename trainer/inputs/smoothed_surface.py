# SPDX-License-Identifier: GPL-3.0-or-later
"""The linearly skinned surface at increasing amounts of smoothing, with tangents and normals at chosen vertices."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy import sparse

from fdda_addon.core.mathematics.surface import adjacent_corners
from fdda_addon.core.rig import Rig

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


SMOOTHING_ITERATIONS = (2, 3, 4, 5, 6, 8, 10, 12, 14, 16, 20, 24, 28, 32, 40, 48, 56, 64)
SMOOTHING_FACTOR = 0.5
"""Factor of each smoothing iteration. One iteration at twice the factor smooths about as much as two iterations."""
EPSILON_RATIO = 0.01
"""Ratio of `SurfaceFrames.epsilons` to the length of the corner's longer tangent in the rest pose. For the
normal it is the ratio to the square of this length. Vectors whose direction is mostly a rounding error fade out."""
MIN_EPSILON = 1e-18
"""Minimum epsilon, mesh units. It applies to corners whose edges have no length."""


class SmoothedSurface:
    """The linearly skinned surface, smoothed as by Corrective Smooth in its simple mode."""

    def __init__(self, rig: Rig):
        """Sort the face corners by vertex, and compute one step of smoothing and the skin weights as a matrix."""
        vertex_count, corner_order = rig.vertex_count, np.argsort(rig.face_vertices, kind="stable")
        corner_vertices = rig.face_vertices[corner_order]
        self._starts = np.searchsorted(corner_vertices, np.arange(vertex_count + 1))
        # The preceding and the following vertex of each corner in its face.
        self._predecessors, self._successors = (
            rig.face_vertices[corners[corner_order]] for corners in adjacent_corners(rig.face_starts, rig.face_vertices)
        )
        edges = np.concatenate([corner_vertices] * 2), np.concatenate([self._predecessors, self._successors])
        adjacency = sparse.coo_array((np.ones(len(edges[0])), edges), (vertex_count, vertex_count)).tocsr()
        adjacency.data[:] = 1
        neighbor_counts = np.asarray(adjacency.sum(axis=1)).ravel()
        isolated_vertices = sparse.diags_array((neighbor_counts == 0).astype(float))
        neighbor_mean = sparse.diags_array(1 / np.maximum(neighbor_counts, 1)) @ adjacency + isolated_vertices
        self._smoothing_step = (
            (1 - SMOOTHING_FACTOR) * sparse.eye_array(vertex_count) + SMOOTHING_FACTOR * neighbor_mean
        ).tocsr()
        vertices = np.repeat(np.arange(vertex_count), rig.skin_joints.shape[1])
        weights, joints = rig.skin_weights.ravel().astype(np.float64), rig.skin_joints.ravel()
        rest = np.append(rig.rest_positions.astype(np.float64), np.ones((vertex_count, 1)), axis=1)
        weighted_rest = weights[:, None] * rest[vertices]
        coordinates = np.repeat(vertices, 4), (4 * joints[:, None] + np.arange(4)).ravel()
        self._weighted_rest = sparse.coo_array(
            (weighted_rest.ravel(), coordinates), (vertex_count, 4 * len(rig.joints))
        ).tocsr()
        self._inverse_rest = np.linalg.inv(rig.rest_matrices.astype(np.float64))

    def surface_frames(self, vertices: np.ndarray, joints: np.ndarray) -> Iterator[tuple[int, SurfaceFrames]]:
        """Compute surface frames with all lengths 1 for each of `SMOOTHING_ITERATIONS`.

        Args:
            vertices, joints: (D,) vertices, and the main joints of their partitions.

        Yields:
            The number of iterations, and the surface frames.
        """
        starts, corner_counts = self._starts[vertices], np.diff(self._starts)[vertices]
        corner_slots = np.arange(corner_counts.max())
        is_corner = corner_slots < corner_counts[:, None]
        corners = starts[:, None] + np.minimum(corner_slots, corner_counts[:, None] - 1)
        # Both edges of a padded corner have length 0.
        edge_ends = np.where(is_corner, (self._predecessors[corners], self._successors[corners]), vertices[:, None])
        nearby_vertices, row_indices = np.unique(np.append(edge_ends.ravel(), vertices), return_inverse=True)
        shape, completed_iterations = (len(nearby_vertices), self._smoothing_step.shape[0]), 0
        smoothing_rows = sparse.csr_array(
            (np.ones(len(nearby_vertices)), (np.arange(len(nearby_vertices)), nearby_vertices)), shape
        )
        for iterations in SMOOTHING_ITERATIONS:
            for _ in range(iterations - completed_iterations):
                smoothing_rows = smoothing_rows @ self._smoothing_step
            completed_iterations = iterations
            smoothed = (smoothing_rows @ self._weighted_rest).toarray()[row_indices]
            predecessor_edges, successor_edges = (
                smoothed[: edge_ends.size].reshape(*edge_ends.shape, -1) - smoothed[edge_ends.size :, None]
            )
            tangents = np.stack([predecessor_edges + successor_edges, successor_edges - predecessor_edges])
            by_joint = tangents.reshape(*tangents.shape[:3], -1, 4)
            # In the rest pose skin matrices are the identity, so the sum over the joints is the tangent.
            extents = np.linalg.norm(by_joint[..., :3].sum(axis=3), axis=3).max(axis=0)
            epsilons = np.maximum(EPSILON_RATIO * np.stack([extents, extents, extents**2]), MIN_EPSILON)
            posed_tangents = np.einsum("jab,fdkjb->fdkja", self._inverse_rest, by_joint).reshape(tangents.shape)
            lengths = np.tile(is_corner, (3, 1, 1)).astype(np.float64)
            yield iterations, SurfaceFrames(vertices, joints, posed_tangents, epsilons, lengths)
