# SPDX-License-Identifier: GPL-3.0-or-later
"""Relaxation of a quad grid on the surface of a field; rings stay in their planes."""

import numpy as np

from .field import Field
from .quads import Grid


def build_neighbor_table(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return (count, k) neighbor indices along edges, padded with the vertex itself, and their (count,) numbers."""
    edges = np.concatenate([faces[:, [i, (i + 1) % 4]] for i in range(4)])
    edges = np.unique(np.sort(edges, axis=1), axis=0)
    both = np.concatenate([edges, edges[:, ::-1]])
    both = both[np.lexsort((both[:, 1], both[:, 0]))]
    valence = np.bincount(both[:, 0], minlength=count)
    table = np.repeat(np.arange(count)[:, None], valence.max(), axis=1)
    place = np.arange(len(both)) - np.repeat(np.cumsum(valence) - valence, valence)
    table[both[:, 0], place] = both[:, 1]
    return table, valence


def smooth_loose_points(grid: Grid) -> np.ndarray:
    """Return the (n, 3) float64 points with loose ones at the mean of their neighbors.

    From there the surface is reached without folds.
    """
    x = grid.points.copy()
    table, valence = build_neighbor_table(grid.faces, len(x))
    loose = np.flatnonzero(grid.loose)
    near, count = table[loose], valence[loose, None]
    spare = table.shape[1] - count
    for _ in range(60):
        x[loose] = (x[near].sum(axis=1) - x[loose] * spare) / count
    return x


def relax(points: np.ndarray, grid: Grid, field: Field, rounds: int) -> np.ndarray:
    """Smooth `points` along the field's surface for a number of rounds, and project them back; (n, 3) float64.

    The step is Newton's, inside the vertex's plane as far as the plane holds it, at most 6 mm long.
    """
    x = points.copy()
    table, valence = build_neighbor_table(grid.faces, len(x))
    spare = table.shape[1] - valence
    normal, hold = grid.plane_normal, grid.plane_hold[:, None]
    outward = np.zeros_like(x)
    for i in range(rounds):
        # The last rounds only settle on the surface.
        if i < rounds - 3:
            mean = (x[table].sum(axis=1) - x * spare[:, None]) / valence[:, None]
            step = (mean - x) * 0.5
            step -= outward * np.einsum("ij,ij->i", step, outward)[:, None]
            x += step
            away = np.einsum("ij,ij->i", x - grid.plane_point, normal)[:, None]
            x -= hold * away * normal
        distance, gradient = field.distance_and_gradient(x)
        size = np.linalg.norm(gradient, axis=1, keepdims=True)
        outward = gradient / np.maximum(size, 1e-6)
        across = np.einsum("ij,ij->i", gradient, normal)[:, None]
        slope = gradient - hold * across * normal
        steep = np.einsum("ij,ij->i", slope, slope)
        # Where the plane lies along the surface there is no way inside it: take the plain gradient.
        slope = np.where((steep < 0.1)[:, None], gradient, slope)
        steep = np.maximum(np.einsum("ij,ij->i", slope, slope), 1e-6)
        x -= slope * np.clip(distance / steep, -0.006, 0.006)[:, None]
    return x
