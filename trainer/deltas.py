# SPDX-License-Identifier: GPL-3.0-or-later
"""How chosen vertices stand out of the smoothed surface, as inputs of networks.

Delta mush smooths the skinned surface and sets the detail of the rest pose, a delta for each vertex, back on it as the
surface lies (Mancewicz and others, Delta Mush, 2014; Blender's Corrective Smooth). Where the surface folds, a small
turn of a joint turns a delta over, and a network that sees joints alone cannot follow. Linear skinning that is smoothed
is linear in the pose matrices, so at a few vertices it costs little to see how it lies: a delta is taken as a sum of
the normals of the faces there, each as long as fits the recording (`delta_fit`). docs/training.md has the errors with
and without.
"""

from dataclasses import dataclass

import numpy as np

from fdda_addon.core.rig import Rig

FEATURES_PER_DELTA = 3
SMALLEST = 1e-18
"""Added to squared lengths that are divided by: a joint that is scaled to nothing gives numbers, not NaN."""
MOST_PARTS = 1 << 12
"""Joints times deltas, at most: a frame reads a number of each joint for the edges at each vertex."""
BLOCK_FLOATS = 1 << 22
"""Poses are looked at in blocks of so many coordinates."""


@dataclass(frozen=True)
class Deltas:
    """D deltas of vertices with up to K corners of faces, and the E edges of these.

    With the columns of all J pose matrices below each other, (4 J, 3), a product with `edges` gives the edges of the
    smoothed surface. The cross product c of a corner's two edges gives its normal c / sqrt(|c|^2 + least^2), which a
    corner without extent does not have.

    Attributes:
        vertices: (D,) int64.
        seen_from: (D,) int64, main joints of their partitions, which they are seen from.
        edges: (E, 4 J) float64, mesh units, of poses as they are.
        corners: (2, D, K) int64, the edge before each corner and the one after it; padded with any.
        least: (D, K) float64, square mesh units, above 0.
        lengths: (D, K) float64, mesh units, what each normal counts for; padded with 0.
    """

    vertices: np.ndarray
    seen_from: np.ndarray
    edges: np.ndarray
    corners: np.ndarray
    least: np.ndarray
    lengths: np.ndarray

    def __len__(self) -> int:
        return len(self.vertices)

    def may_be_of(self, rig: Rig) -> bool:
        """Whether a rig can have them."""
        joints, vertices = len(rig.joints), rig.vertex_count
        known = self.seen_from.max(initial=0) < joints and self.vertices.max(initial=0) < vertices
        few = len(self) * joints <= MOST_PARTS
        return known and few and (not len(self) or self.edges.shape[1] == 4 * joints)

    def chosen(self, which: np.ndarray) -> "Deltas":
        """Those of them that (D,) bool says."""
        used = (self.lengths[which] != 0).any(axis=0)
        corners = self.corners[:, which][:, :, used]
        edges, places = np.unique(corners, return_inverse=True)
        return Deltas(
            *(self.vertices[which], self.seen_from[which]),
            *(self.edges[edges], places.reshape(corners.shape)),
            *(self.least[which][:, used], self.lengths[which][:, used]),
        )

    def seen(self, pose_matrices: np.ndarray) -> np.ndarray:
        """The deltas in poses, along the axes of their main joints: the same for a character that is scaled as a whole.

        Args:
            pose_matrices: (N, J, 4, 4), mesh-object space, mesh units.

        Returns:
            (N, 3 D) float32, mesh units.
        """
        count, found = len(self), np.empty((len(pose_matrices), FEATURES_PER_DELTA * len(self)), np.float32)
        step = max(1, BLOCK_FLOATS // max(1, 9 * self.corners.size))
        for start in range(0, len(found) if count else 0, step):
            poses = pose_matrices[start : start + step].astype(np.float64)
            turned = np.einsum("ndck,dc->ndk", self.normals(poses), self.lengths)
            axes = poses[:, self.seen_from, :3, :3]
            axes /= np.sqrt((axes**2).sum(axis=2, keepdims=True) + SMALLEST)
            found[start : start + step] = np.einsum("ndab,nda->ndb", axes, turned).reshape(len(poses), -1)
        return found

    def normals(self, pose_matrices: np.ndarray) -> np.ndarray:
        """(N, J, 4, 4) pose matrices to (N, D, K, 3) float64 normals of the corners, mesh-object space."""
        columns = pose_matrices[:, :, :3].astype(np.float64).swapaxes(2, 3).reshape(len(pose_matrices), -1, 3)
        edges = self.edges @ columns
        before, after = (edges[:, own] for own in self.corners)
        crossed = np.cross(before, after)
        squared = (crossed**2).sum(axis=3) + self.least**2
        return crossed / np.sqrt(squared)[..., None]


NO_DELTAS = Deltas(
    *(np.zeros(0, np.int64) for _ in range(2)),
    np.zeros((0, 0)),
    np.zeros((2, 0, 1), np.int64),
    *(np.zeros((0, 1)) for _ in range(2)),
)
