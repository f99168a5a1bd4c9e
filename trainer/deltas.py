# SPDX-License-Identifier: GPL-3.0-or-later
"""How chosen vertices stand out of the smoothed surface, as inputs of networks.

Delta mush smooths the skinned surface and sets the detail of the rest pose, a delta for each vertex, back on it as the
surface lies (Mancewicz and others, Delta Mush, 2014; Blender's Corrective Smooth). Where the surface folds, a small
turn of a joint turns a delta over, and a network that sees joints alone cannot follow. Linear skinning that is smoothed
is linear in the pose matrices, so at a few vertices it costs little to see how it lies: a delta is taken as a sum of
tangents and normals of the corners of faces there, each as long as fits the recording (`delta_fit`).
docs/experiments.md has the errors with and without.
"""

from dataclasses import dataclass

import numpy as np

from fdda_addon.core.rig import Rig

FEATURES_PER_DELTA = 3
SMALLEST = 1e-18
"""Added to squared lengths that are divided by: a joint that is scaled to nothing gives numbers, not NaN."""
MOST_PARTS = 1 << 12
"""Joints times deltas, at most: a frame reads a number of each joint for the tangents at each vertex."""
BLOCK_FLOATS = 1 << 22
"""Poses are looked at in blocks of so many coordinates."""


@dataclass(frozen=True)
class Deltas:
    """D deltas of vertices with up to K corners of faces.

    With a and b the edges of the smoothed surface from a vertex to the one before and the one after it in a face, the
    corner has the tangents a + b and b - a, and their cross product is along its normal. Each vector v counts as
    v / sqrt(|v|^2 + least^2), of length 1 unless the corner has lost its extent.

    Attributes:
        vertices: (D,) int64.
        seen_from: (D,) int64, main joints of their partitions, which they are seen from.
        tangents: (2, D, K, 4 J) float64, mesh units: products with the columns of all pose matrices below each other,
            (4 J, 3), are the tangents. Padded with 0.
        least: (3, D, K) float64, of the tangents in mesh units, of the normal in square mesh units; above 0.
        lengths: (3, D, K) float64, mesh units, what tangents and normal count for; padded with 0.
    """

    vertices: np.ndarray
    seen_from: np.ndarray
    tangents: np.ndarray
    least: np.ndarray
    lengths: np.ndarray

    def __len__(self) -> int:
        return len(self.vertices)

    def may_be_of(self, rig: Rig) -> bool:
        """Whether a rig can have them."""
        joints, vertices = len(rig.joints), rig.vertex_count
        known = self.seen_from.max(initial=0) < joints and self.vertices.max(initial=0) < vertices
        few = len(self) * joints <= MOST_PARTS
        return known and few and (not len(self) or self.tangents.shape[3] == 4 * joints)

    def chosen(self, which: np.ndarray) -> "Deltas":
        """Those of them that (D,) bool says."""
        used = (self.lengths[:, which] != 0).any(axis=(0, 1))
        corners = (array[:, which][:, :, used] for array in (self.tangents, self.least, self.lengths))
        return Deltas(self.vertices[which], self.seen_from[which], *corners)

    def seen(self, pose_matrices: np.ndarray) -> np.ndarray:
        """The deltas in poses, along the axes of their main joints: the same for a character that is scaled as a whole.

        Args:
            pose_matrices: (N, J, 4, 4), mesh-object space, mesh units.

        Returns:
            (N, 3 D) float32, mesh units.
        """
        count, found = len(self), np.empty((len(pose_matrices), FEATURES_PER_DELTA * len(self)), np.float32)
        step = max(1, BLOCK_FLOATS // max(1, 3 * self.lengths.size))
        for start in range(0, len(found) if count else 0, step):
            poses = pose_matrices[start : start + step].astype(np.float64)
            turned = np.einsum("nfdkc,fdk->ndc", self.frames(poses), self.lengths)
            axes = poses[:, self.seen_from, :3, :3]
            axes /= np.sqrt((axes**2).sum(axis=2, keepdims=True) + SMALLEST)
            found[start : start + step] = np.einsum("ndab,nda->ndb", axes, turned).reshape(len(poses), -1)
        return found

    def frames(self, pose_matrices: np.ndarray) -> np.ndarray:
        """(N, J, 4, 4) pose matrices to (N, 3, D, K, 3) float64 tangents and normals of corners, mesh-object space."""
        columns = pose_matrices[:, :, :3].astype(np.float64).swapaxes(2, 3).reshape(len(pose_matrices), -1, 3)
        size = self.tangents.shape
        tangents = (self.tangents.reshape(-1, size[3]) @ columns).reshape(len(columns), *size[:3], 3)
        frames = np.append(tangents, np.cross(tangents[:, :1], tangents[:, 1:]), axis=1)
        return frames / np.sqrt((frames**2).sum(axis=4) + self.least**2)[..., None]


NO_DELTAS = Deltas(
    *(np.zeros(0, np.int64) for _ in range(2)),
    np.zeros((2, 0, 1, 0)),
    *(np.zeros((3, 0, 1)) for _ in range(2)),
)
