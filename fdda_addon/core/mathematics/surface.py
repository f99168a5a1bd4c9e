# SPDX-License-Identifier: GPL-3.0-or-later
"""Surface of a mesh, and errors that are visible in shading: angles between normals, differences of edge lengths."""

from dataclasses import dataclass

import numpy as np

from .partition import Partition

MIN_CORNERS = 3
"""Smallest number of vertices of a face."""


def are_faces(face_starts: np.ndarray, face_vertices: np.ndarray, vertex_count: int) -> bool:
    """Return whether two arrays are valid faces of a mesh, as in `Rig`; no faces at all are valid."""
    if not len(face_starts):
        return not len(face_vertices)
    corners = np.diff(face_starts.astype(np.int64), append=len(face_vertices))
    return bool(
        face_starts[0] == 0
        and corners.min() >= MIN_CORNERS
        and face_vertices.min() >= 0
        and face_vertices.max() < vertex_count
    )


def adjacent_corners(face_starts: np.ndarray, face_vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the previous and the next corner of each corner in its face.

    Args:
        face_starts, face_vertices: (F,) and (C,) int32 as in `Rig`, at least one face.

    Returns:
        (C,) int64 indices of the previous and of the next corners.
    """
    next_corner = np.arange(1, len(face_vertices) + 1)
    next_corner[np.append(face_starts[1:], len(face_vertices)) - 1] = face_starts
    previous_corner = np.empty_like(next_corner)
    previous_corner[next_corner] = np.arange(len(face_vertices))
    return previous_corner, next_corner


class Surface:
    """The faces of a mesh, prepared to compute the normals of many poses.

    Attributes:
        vertices: (n,) int32, ascending indices of the vertices that belong to faces; only these have normals.
        edges: (E, 2) int32, indices of the vertices of each edge, the lower index first; each edge occurs once.
    """

    def __init__(self, face_starts: np.ndarray, face_vertices: np.ndarray):
        """Args:
        face_starts, face_vertices: (F,) and (C,) int32 as in `Rig`, at least one face.
        """
        counts = np.diff(face_starts, append=len(face_vertices))
        self._starts, self._corners = face_starts, face_vertices
        self._face_of_corner = np.repeat(np.arange(len(face_starts)), counts)
        self._previous, self._next = adjacent_corners(face_starts, face_vertices)
        # Sorted by vertex, the corners of a vertex are adjacent, so that `np.add.reduceat` sums them.
        self._by_vertex = np.argsort(face_vertices, kind="stable")
        self.vertices, self._vertex_starts = np.unique(face_vertices[self._by_vertex], return_index=True)
        ends = np.sort(np.stack([face_vertices, face_vertices[self._next]], axis=1), axis=1)
        self.edges = np.unique(ends, axis=0)

    def normals(self, positions: np.ndarray) -> np.ndarray:
        """Compute vertex normals as Blender does: face normals weighted by the angle of the corner.

        The normal of a polygon follows Newell's method.

        Args:
            positions: (V, 3), one pose.

        Returns:
            (n, 3) float64 unit vectors for `vertices`; zero where all faces at a vertex have no area.
        """
        # Far from the origin, differences of corner positions are more precise than the positions.
        corners = positions[self._corners].astype(np.float64)
        edge_vectors = corners[self._next] - corners
        from_first_corner = corners - corners[self._starts][self._face_of_corner]
        face_normals = _normalize(np.add.reduceat(np.cross(from_first_corner, edge_vectors), self._starts))
        edge_vectors = _normalize(edge_vectors)
        corner_angles = np.arccos(np.clip(-np.einsum("cx,cx->c", edge_vectors, edge_vectors[self._previous]), -1, 1))
        weighted_normals = face_normals[self._face_of_corner] * corner_angles[:, None]
        return _normalize(np.add.reduceat(weighted_normals[self._by_vertex], self._vertex_starts))

    def edge_lengths(self, positions: np.ndarray) -> np.ndarray:
        """Compute the (E,) edge lengths of (V, 3) positions, in the unit of the positions."""
        ends = positions[self.edges]
        return np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)


def _normalize(vectors: np.ndarray) -> np.ndarray:
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0)


def angles_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Compute the angles between (n, 3) unit vectors.

    Returns:
        (n,) float64, degrees; 90 where one of two vectors is zero, and 0 where both are zero.
    """
    # The arc cosine is inexact for small angles: an error of 1e-8 in the dot product is 0.008 degrees.
    cross = np.linalg.norm(np.cross(first, second), axis=-1)
    dot = np.einsum("nx,nx->n", first, second)
    is_one_zero = first.any(axis=-1) != second.any(axis=-1)
    return np.where(is_one_zero, 90.0, np.degrees(np.arctan2(cross, dot)))


@dataclass(frozen=True)
class SurfaceErrors:
    """Errors of a surface over poses.

    Attributes:
        angles: (N, n) float32, between the normals, degrees.
        across: (N,) float64, mean relative error of the lengths of edges between two partitions.
        beside: (N,) float64, mean relative error for edges inside of partitions that touch an edge between partitions.
        inside: (N,) float64, mean relative error for all edges inside of partitions.
    """

    angles: np.ndarray
    across: np.ndarray
    beside: np.ndarray
    inside: np.ndarray

    def normals_json(self) -> dict:
        """Return statistics of the angles over poses and vertices, degrees."""
        angles = self.angles.astype(np.float64)
        return {"mean": float(angles.mean()), "p99": float(np.percentile(angles, 99)), "max": float(angles.max())}

    def edges_json(self) -> dict:
        """Return the mean relative error of edge lengths for each kind of edges; None for a kind without edges."""
        mean_errors = {
            kind: float(errors.mean()) if np.isfinite(errors).all() else None
            for kind, errors in (("across", self.across), ("beside", self.beside), ("inside", self.inside))
        }
        has_ratio = mean_errors["across"] is not None and mean_errors["inside"]
        return {**mean_errors, "ratio": mean_errors["across"] / mean_errors["inside"] if has_ratio else None}


def surface_json(fdda_errors: SurfaceErrors | None, linear_errors: SurfaceErrors | None) -> dict:
    """Return the errors `normals` (degrees) and `edges` (relative) of the model and of linear skinning.

    Both are None where the mesh has no faces.
    """
    if fdda_errors is None or linear_errors is None:
        return {"normals": None, "edges": None}
    methods = {"fdda": fdda_errors, "linear": linear_errors}
    return {
        "normals": {method: errors.normals_json() for method, errors in methods.items()},
        "edges": {method: errors.edges_json() for method, errors in methods.items()},
    }


class SurfaceComparison:
    """Comparison of deformed surfaces with the surface that the rig evaluates, one pose at a time."""

    def __init__(self, surface: Surface, rest_positions: np.ndarray, partitions: tuple[Partition, ...]):
        """Args:
        surface: surface of the mesh.
        rest_positions: (V, 3), mesh units.
        partitions: partitions of the mesh.
        """
        self._surface = surface
        self._rest_lengths = surface.edge_lengths(rest_positions).astype(np.float64)
        partition_of = np.empty(len(rest_positions), np.int32)
        for index, partition in enumerate(partitions):
            partition_of[partition.vertices] = index
        has_length = self._rest_lengths > 0
        crosses_border = np.diff(partition_of[surface.edges], axis=1)[:, 0] != 0
        at_border = np.isin(surface.edges, surface.edges[crosses_border]).any(axis=1)
        edge_kinds = (crosses_border, ~crosses_border & at_border, ~crosses_border)
        self._kinds = [np.flatnonzero(is_of_kind & has_length) for is_of_kind in edge_kinds]

    def compare(
        self, rig_positions: np.ndarray, compared_positions: tuple[np.ndarray, ...]
    ) -> list[tuple[np.ndarray, float, float, float]]:
        """Compare surfaces in one pose with the surface of the rig.

        Args:
            rig_positions: (V, 3) positions that the rig evaluates, mesh units.
            compared_positions: one or more arrays of positions, of the same shape and unit.

        Returns:
            For each array of `compared_positions`, one row of the arrays of `SurfaceErrors`.
        """
        surface = self._surface
        normals, lengths = surface.normals(rig_positions), surface.edge_lengths(rig_positions)
        rows = []
        for positions in compared_positions:
            angles = angles_between(normals, surface.normals(positions)).astype(np.float32)
            errors = np.abs(surface.edge_lengths(positions) - lengths)
            ratios = [errors[edges] / self._rest_lengths[edges] for edges in self._kinds]
            rows.append((angles, *(float(np.mean(each)) if len(each) else np.nan for each in ratios)))
        return rows


def surface_errors(rows: list[tuple[np.ndarray, float, float, float]]) -> SurfaceErrors:
    """Combine the rows of `SurfaceComparison.compare` for one method; `rows` has one row per pose, at least one."""
    return SurfaceErrors(*(np.array(column) for column in zip(*rows, strict=True)))
