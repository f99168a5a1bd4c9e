# SPDX-License-Identifier: GPL-3.0-or-later
"""Patches: small parts of partitions, on which few joints act even where a partition is as large as the body."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .partition import Partition
from .rig import Rig

MAX_PATCH_VERTICES = 16
"""Largest number of vertices of a patch. Smaller patches have fewer influences but cost more memory."""


@dataclass(frozen=True)
class Patches:
    """Division of the V vertices of a mesh into Q patches; each lies in one partition.

    Attributes:
        vertices: (V,) indices of the vertices, sorted by patch.
        starts: (Q,) index in `vertices` of the first vertex of each patch.
        partition_starts: (P,) index of the first patch of each partition.
    """

    vertices: np.ndarray
    starts: np.ndarray
    partition_starts: np.ndarray

    @cached_property
    def partition_of_patch(self) -> np.ndarray:
        """(Q,) index of the partition of each patch."""
        counts = np.diff(np.append(self.partition_starts, len(self.starts)))
        return np.repeat(np.arange(len(counts)), counts)

    def sort(self, vectors: np.ndarray) -> np.ndarray:
        """Sort (..., V, 3) vectors of vertices by patch."""
        return np.take(vectors, self.vertices, axis=-2)

    def select(self, patches: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Select the vertices of patches.

        Args:
            patches: (K,) ascending indices of patches.

        Returns:
            Ascending indices in sorted vectors, and (K,) the index of the first one of each patch.
        """
        sizes = np.diff(np.append(self.starts, len(self.vertices)))[patches]
        starts = np.cumsum(sizes) - sizes
        return np.repeat(self.starts[patches] - starts, sizes) + np.arange(sizes.sum()), starts

    def any_of_partition(self, of_patches: np.ndarray) -> np.ndarray:
        """Return (N, P) bool: whether (N, Q) bool values are true for any patch of a partition."""
        return np.logical_or.reduceat(of_patches, self.partition_starts, axis=1)

    def nearby_joints(self, rig: Rig) -> np.ndarray:
        """Find the joints with a weight on a vertex of a patch, or on a vertex that an edge connects with it.

        Returns:
            (J, Q) bool.
        """
        patch_of_vertex = np.empty(len(self.vertices), np.int64)
        patch_of_vertex[self.vertices] = np.repeat(
            np.arange(len(self.starts)), np.diff(np.append(self.starts, len(self.vertices)))
        )
        next_corners = np.arange(1, len(rig.face_vertices) + 1)
        next_corners[np.roll(rig.face_starts, -1) - 1] = rig.face_starts  # After the last corner comes the first one.
        first, second = rig.face_vertices, rig.face_vertices[next_corners]
        every = np.arange(rig.vertex_count)
        weighted, near = np.concatenate([every, first, second]), np.concatenate([every, second, first])
        nearby = np.zeros((len(rig.joints), len(self.starts)), bool)
        for slot in range(rig.skin_joints.shape[1]):
            has_weight = rig.skin_weights[weighted, slot] > 0
            nearby[rig.skin_joints[weighted[has_weight], slot], patch_of_vertex[near[has_weight]]] = True
        return nearby


def largest_norms(vectors: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Compute the largest norm in each of K patches.

    Args:
        vectors: (..., V, 3) vectors of vertices, sorted by patch.
        starts: (K,) index of the first vertex of each patch.

    Returns:
        (..., K).
    """
    return np.maximum.reduceat(np.linalg.norm(vectors, axis=-1), starts, axis=-1)


def divide_into_patches(rig: Rig, partitions: tuple[Partition, ...], max_vertices: int = MAX_PATCH_VERTICES) -> Patches:
    """Divide partitions into patches, by cutting each along its longest axis until its parts are small enough."""
    patches: list[np.ndarray] = []

    def cut(vertices: np.ndarray) -> None:
        if len(vertices) <= max_vertices:
            patches.append(vertices)
            return
        positions = rig.rest_positions[vertices]
        axis = int(np.argmax(np.ptp(positions, axis=0)))
        ordered = vertices[np.argsort(positions[:, axis], kind="stable")]
        cut(ordered[: len(ordered) // 2])
        cut(ordered[len(ordered) // 2 :])

    partition_starts = []
    for partition in partitions:
        partition_starts.append(len(patches))
        cut(partition.vertices)
    starts = np.cumsum([0, *map(len, patches[:-1])])
    return Patches(np.concatenate(patches), starts, np.array(partition_starts))
