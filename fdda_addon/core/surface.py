# SPDX-License-Identifier: GPL-3.0-or-later
"""The surface of a mesh, and what shading shows of its errors: angles between normals, lengths of edges."""

from dataclasses import dataclass

import numpy as np

from .partition import Partition

MIN_CORNERS = 3
"""A face has at least this number of vertices."""


def are_faces(face_starts: np.ndarray, face_vertices: np.ndarray, vertex_count: int) -> bool:
    """Whether two arrays are the faces of a mesh of so many vertices, as in `Rig`. No faces at all are good too."""
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
    """The corner before and the corner after each, along its face: (C,) int64 both.

    Args:
        face_starts, face_vertices: (F,) and (C,) int32 as in `Rig`, at least one face.
    """
    after = np.arange(1, len(face_vertices) + 1)
    after[np.append(face_starts[1:], len(face_vertices)) - 1] = face_starts
    before = np.empty_like(after)
    before[after] = np.arange(len(face_vertices))
    return before, after


class Surface:
    """The faces of a mesh, made ready to give the normals of one pose after another.

    Attributes:
        vertices: (n,) int32, the vertices that have faces, ascending; no others have normals.
        edges: (E, 2) int32, vertices of the edges of the faces, each edge once, the lower vertex first.
    """

    def __init__(self, face_starts: np.ndarray, face_vertices: np.ndarray):
        """Args:
        face_starts, face_vertices: (F,) and (C,) int32 as in `Rig`, at least one face.
        """
        counts = np.diff(face_starts, append=len(face_vertices))
        self._starts, self._corners = face_starts, face_vertices
        self._face_of_corner = np.repeat(np.arange(len(face_starts)), counts)
        self._previous, self._next = adjacent_corners(face_starts, face_vertices)
        # Corners in the order of their vertices: the sums at a vertex are then sums of neighbours.
        self._by_vertex = np.argsort(face_vertices, kind="stable")
        self.vertices, self._vertex_starts = np.unique(face_vertices[self._by_vertex], return_index=True)
        ends = np.sort(np.stack([face_vertices, face_vertices[self._next]], axis=1), axis=1)
        self.edges = np.unique(ends, axis=0)

    def normals(self, positions: np.ndarray) -> np.ndarray:
        """Vertex normals as Blender computes them: normals of the faces, weighted by the angle of the corner.

        The normal of a face with more than three corners is Newell's, that of its area vector.

        Args:
            positions: (V, 3), one pose.

        Returns:
            (n, 3) float64 unit vectors, of `vertices`; zero where all faces at a vertex have no area.
        """
        # Between corners, so that it does not matter how far away from the origin the mesh is.
        corners = positions[self._corners].astype(np.float64)
        along = corners[self._next] - corners
        from_first = corners - corners[self._starts][self._face_of_corner]
        faces = _unit(np.add.reduceat(np.cross(from_first, along), self._starts))
        along = _unit(along)
        angles = np.arccos(np.clip(-np.einsum("cx,cx->c", along, along[self._previous]), -1, 1))
        weighted = faces[self._face_of_corner] * angles[:, None]
        return _unit(np.add.reduceat(weighted[self._by_vertex], self._vertex_starts))

    def edge_lengths(self, positions: np.ndarray) -> np.ndarray:
        """(V, 3) positions of one pose to (E,) lengths of the edges, in the same unit."""
        ends = positions[self.edges]
        return np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0)


def angles_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angles between unit vectors, (n, 3) and (n, 3), as (n,) float64 degrees; 90 where one is zero, 0 where both."""
    # The arc cosine of a dot product loses small angles: 1e-8 of it is 0.008 degrees.
    cross = np.linalg.norm(np.cross(first, second), axis=-1)
    dot = np.einsum("nx,nx->n", first, second)
    lost = first.any(axis=-1) != second.any(axis=-1)
    return np.where(lost, 90.0, np.degrees(np.arctan2(cross, dot)))


@dataclass(frozen=True)
class SurfaceErrors:
    """Errors of the surface over poses.

    Attributes:
        angles: (N, n) float32, between the normals, degrees.
        across: (N,) float64, mean error of the lengths of the edges between two partitions, each as a part of its
            rest length.
        beside: (N,) float64, the same of the edges inside partitions that end at a border.
        inside: (N,) float64, the same of all edges inside partitions.
    """

    angles: np.ndarray
    across: np.ndarray
    beside: np.ndarray
    inside: np.ndarray

    def normals_json(self) -> dict:
        """Angles over poses and vertices, degrees."""
        angles = self.angles.astype(np.float64)
        return {"mean": float(angles.mean()), "p99": float(np.percentile(angles, 99)), "max": float(angles.max())}

    def edges_json(self) -> dict:
        """Errors of edge lengths as parts of the rest length; None for what there is no edge of."""
        found = {
            kind: float(errors.mean()) if np.isfinite(errors).all() else None
            for kind, errors in (("across", self.across), ("beside", self.beside), ("inside", self.inside))
        }
        known = found["across"] is not None and found["inside"]
        return {**found, "ratio": found["across"] / found["inside"] if known else None}


def surface_json(fdda: SurfaceErrors | None, linear: SurfaceErrors | None) -> dict:
    """`normals`, degrees, and `edges`, parts of the rest length, of both ways; None without faces."""
    if fdda is None or linear is None:
        return {"normals": None, "edges": None}
    ways = {"fdda": fdda, "linear": linear}
    return {
        "normals": {way: errors.normals_json() for way, errors in ways.items()},
        "edges": {way: errors.edges_json() for way, errors in ways.items()},
    }


class SurfaceComparison:
    """Compares the surfaces of poses with the true ones, a pose at a time."""

    def __init__(self, surface: Surface, rest_positions: np.ndarray, partitions: tuple[Partition, ...]):
        """Args:
        surface: of the mesh.
        rest_positions: (V, 3), mesh units.
        partitions: of the mesh.
        """
        self._surface = surface
        self._rest_lengths = surface.edge_lengths(rest_positions).astype(np.float64)
        partition_of = np.empty(len(rest_positions), np.int32)
        for number, partition in enumerate(partitions):
            partition_of[partition.vertices] = number
        measured = self._rest_lengths > 0
        crosses = np.diff(partition_of[surface.edges], axis=1)[:, 0] != 0
        at_border = np.isin(surface.edges, surface.edges[crosses]).any(axis=1)
        kinds = (crosses, ~crosses & at_border, ~crosses)
        self._kinds = [np.flatnonzero(kind & measured) for kind in kinds]

    def compare(self, true: np.ndarray, others: tuple[np.ndarray, ...]) -> list[tuple[np.ndarray, float, float, float]]:
        """Compare other positions of a pose with the true ones.

        Args:
            true: (V, 3), mesh units.
            others: one or more of the same.

        Returns:
            For each of the others, the row that it adds to the arrays of `SurfaceErrors`.
        """
        surface = self._surface
        normals, lengths = surface.normals(true), surface.edge_lengths(true)
        rows = []
        for other in others:
            angles = angles_between(normals, surface.normals(other)).astype(np.float32)
            errors = np.abs(surface.edge_lengths(other) - lengths)
            rows.append((angles, *(self._mean(errors, edges) for edges in self._kinds)))
        return rows

    def _mean(self, errors: np.ndarray, edges: np.ndarray) -> float:
        return float(np.mean(errors[edges] / self._rest_lengths[edges])) if len(edges) else np.nan


def surface_errors(rows: list[tuple[np.ndarray, float, float, float]]) -> SurfaceErrors:
    """Put together what `SurfaceComparison.compare` returned for one way over all poses, at least one."""
    return SurfaceErrors(*(np.array(column) for column in zip(*rows, strict=True)))
