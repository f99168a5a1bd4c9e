# SPDX-License-Identifier: GPL-3.0-or-later
"""Division of partitions into parts: by mesh, and by the shape keys that vertices need.

A sleeve and the arm in it follow the same joints, but not the same way: common components would be those of the mesh
that moves more, and each would cost constants for both.

A key moves few vertices of a face, but the factors of one matrix have a number for each vertex and each direction in
which any vertex of the matrix moves. So a large partition is bisected, as long as its parts need fewer parameters.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fdda_addon.core.mathematics.partition import Partition
from fdda_addon.core.rig import Rig

from .joint_fit import JointFit
from .low_rank import TOLERANCE_RATIO

PART_PARAMETERS = 20_000
"""Parameters and time of one more part, with its network and its products, as a number of parameters."""
BISECTION_STEPS = 10
"""Number of times that vertices move to the nearer of two centers."""


def mesh_of(rig: Rig, partition: Partition) -> int:
    """Return the index of the mesh that has the most vertices of a partition."""
    stops = [part.stop for part in rig.mesh_slices]
    return int(np.bincount(np.searchsorted(stops, partition.vertices, side="right")).argmax())


def divide_by_mesh(rig: Rig, partitions: Sequence[Partition], min_vertices: int) -> list[Partition]:
    """Divide partitions by mesh; the vertices of a mesh that has fewer than `min_vertices` stay with others."""
    divided = []
    for partition in partitions:
        pieces = np.split(partition.vertices, np.searchsorted(partition.vertices, [s.stop for s in rig.mesh_slices]))
        pieces = sorted((piece for piece in pieces if len(piece)), key=len, reverse=True)
        large = [piece for piece in pieces[1:] if len(piece) >= min_vertices]
        first = np.sort(np.concatenate([pieces[0], *pieces[1 + len(large) :]]))
        divided += [replace(partition, vertices=piece) for piece in (first, *large)]
    return divided


def divide_partition(fit: JointFit, spreads: np.ndarray, tolerance: float) -> list[np.ndarray]:
    """Divide the vertices of a partition into parts.

    Args:
        fit: fit of the partition.
        spreads: (S,) standard deviations of its shape keys over the training poses.
        tolerance: rms error over poses and vertices that the components may leave, mesh units.

    Returns:
        Ascending indices of the Vp vertices of each part.
    """
    vertex_count = fit.factors.shape[1]
    # Rounding would make the smallest singular values of float32 Gram matrices larger than the tolerance.
    motions = fit.control_factors.astype(np.float64) * np.repeat(spreads, 3)[:, None] / tolerance
    needs = np.log1p(np.linalg.norm(motions.reshape(len(fit.controls), 3, vertex_count), axis=1)).T

    def divide(vertices: np.ndarray, cost: float) -> list[np.ndarray]:
        halves = [vertices[half] for half in _bisect(needs[vertices])]
        if any(not len(half) for half in halves):
            return [vertices]
        costs = [_parameter_count(motions[:, half]) for half in halves]
        if sum(costs) + PART_PARAMETERS >= cost:
            return [vertices]
        return [part for pair in zip(halves, costs, strict=True) for part in divide(*pair)]

    every_vertex = np.arange(vertex_count)
    if not len(fit.controls) or len(motions) * vertex_count < PART_PARAMETERS:
        return [every_vertex]
    return divide(every_vertex, _parameter_count(motions))


def _parameter_count(motions: np.ndarray) -> int:
    """Return the parameters that (3 S, n) factors of shape keys need, factorized; `motions` in tolerances."""
    motions = motions[np.abs(motions).max(axis=1) > TOLERANCE_RATIO]
    squares = np.maximum(np.linalg.eigvalsh(motions @ motions.T), 0) if len(motions) else np.zeros(0)
    errors = np.sqrt(np.append(0, np.cumsum(squares)) / motions.shape[1])
    rank = int((errors > TOLERANCE_RATIO).sum())
    return min(rank * (motions.shape[1] + len(motions)), motions.size)


def _bisect(needs: np.ndarray) -> list[np.ndarray]:
    """Divide (n, S) needs of vertices into two halves with similar needs; returns (n,) bool of each."""
    centered = needs - needs.mean(axis=0)
    direction = np.linalg.eigh(centered.T @ centered)[1][:, -1]
    is_second = centered @ direction > 0
    for _ in range(BISECTION_STEPS):
        if is_second.all() or not is_second.any():
            break
        centers = [needs[~is_second].mean(axis=0), needs[is_second].mean(axis=0)]
        middle, difference = (centers[0] + centers[1]) / 2, centers[1] - centers[0]
        is_second = (needs - middle) @ difference > 0
    return [~is_second, is_second]
