# SPDX-License-Identifier: GPL-3.0-or-later
"""Relaxes a quad grid on the surface of a field, while rings stay in their planes."""

import numpy as np

from .field import Field
from .quads import Grid


def build_neighbor_table(faces: np.ndarray, vertex_count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the neighbors of n vertices, (n, k) indices padded with the vertex itself, and their (n,) numbers."""
    edges = np.concatenate([faces[:, [corner, (corner + 1) % 4]] for corner in range(4)])
    edges = np.unique(np.sort(edges, axis=1), axis=0)
    directed_edges = np.concatenate([edges, edges[:, ::-1]])
    directed_edges = directed_edges[np.lexsort((directed_edges[:, 1], directed_edges[:, 0]))]
    valence = np.bincount(directed_edges[:, 0], minlength=vertex_count)
    table = np.repeat(np.arange(vertex_count)[:, None], valence.max(), axis=1)
    columns = np.arange(len(directed_edges)) - np.repeat(np.cumsum(valence) - valence, valence)
    table[directed_edges[:, 0], columns] = directed_edges[:, 1]
    return table, valence


def smooth_loose_points(grid: Grid) -> np.ndarray:
    """Return the (n, 3) float64 points, with each loose point at the mean of its neighbors.

    From these positions, relaxation reaches the surface without folds.
    """
    positions = grid.points.copy()
    neighbors, valence = build_neighbor_table(grid.faces, len(positions))
    loose_indices = np.flatnonzero(grid.loose)
    loose_neighbors, loose_valence = neighbors[loose_indices], valence[loose_indices, None]
    padding_count = neighbors.shape[1] - loose_valence
    for _ in range(60):
        positions[loose_indices] = (
            positions[loose_neighbors].sum(axis=1) - positions[loose_indices] * padding_count
        ) / loose_valence
    return positions


def relax(points: np.ndarray, grid: Grid, field: Field, rounds: int) -> np.ndarray:
    """Smooth points along the surface of a field for a number of rounds, and project them onto it; (n, 3) float64.

    The projection is a Newton step of at most 6 mm, in the plane of the vertex as far as the plane holds it.
    """
    positions = points.copy()
    neighbors, valence = build_neighbor_table(grid.faces, len(positions))
    padding_count = neighbors.shape[1] - valence
    plane_normals, plane_hold = grid.plane_normal, grid.plane_hold[:, None]
    surface_normals = np.zeros_like(positions)
    for round_index in range(rounds):
        # The last rounds only project the points onto the surface.
        if round_index < rounds - 3:
            neighbor_mean = (positions[neighbors].sum(axis=1) - positions * padding_count[:, None]) / valence[:, None]
            step = (neighbor_mean - positions) * 0.5
            step -= surface_normals * np.einsum("ij,ij->i", step, surface_normals)[:, None]
            positions += step
            plane_distance = np.einsum("ij,ij->i", positions - grid.plane_point, plane_normals)[:, None]
            positions -= plane_hold * plane_distance * plane_normals
        distance, gradient = field.distance_and_gradient(positions)
        gradient_length = np.linalg.norm(gradient, axis=1, keepdims=True)
        surface_normals = gradient / np.maximum(gradient_length, 1e-6)
        normal_component = np.einsum("ij,ij->i", gradient, plane_normals)[:, None]
        step_direction = gradient - plane_hold * normal_component * plane_normals
        squared_slope = np.einsum("ij,ij->i", step_direction, step_direction)
        # If the plane is almost tangential to the surface, no step in the plane reaches it, so use the gradient itself.
        step_direction = np.where((squared_slope < 0.1)[:, None], gradient, step_direction)
        squared_slope = np.maximum(np.einsum("ij,ij->i", step_direction, step_direction), 1e-6)
        positions -= step_direction * np.clip(distance / squared_slope, -0.006, 0.006)[:, None]
    return positions
