# SPDX-License-Identifier: GPL-3.0-or-later
"""Quad grids: their subdivision and construction, and interpolation from a coarser grid.

The vertices of a grid form sheets. A sheet is a rectangular array of vertices in rows and columns, such as the tube of
the arm, a finger or a fingertip.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np


@dataclass(frozen=True)
class Divisions:
    """Numbers of faces in each direction.

    Attributes:
        finger, web, side: across a finger, across a web, and across the side of the hand.
        rings: along the arm: from the shoulder to the elbow, to the wrist, and to the webs.
        finger_rings, thumb_rings: along a finger from the webs, and along the thumb.
        thumb_root: along the hand, where the thumb grows out of it.
    """

    finger: int
    web: int
    side: int
    rings: tuple[int, int, int]
    finger_rings: int
    thumb_root: int
    thumb_rings: int


# By density. The grid of density 1 is also the guide whose sculpted points initialize the finer grids.
DIVISIONS = {
    1: Divisions(2, 1, 2, (15, 11, 10), 12, 3, 11),
    2: Divisions(5, 3, 5, (39, 30, 26), 31, 8, 28),
    3: Divisions(12, 6, 12, (86, 66, 58), 66, 18, 60),
}


@dataclass(frozen=True)
class SheetPosition:
    """Position of a vertex in a sheet; row and column are in faces of density 1."""

    sheet: str
    row: float
    column: float


@dataclass
class Grid:
    """Quads before sculpting: n vertices and f faces.

    Attributes:
        points: (n, 3) float64, meters, arm space.
        faces: (f, 4) int32, oriented outwards.
        digit: (n,) int; -1 for arm and palm, 0 for the thumb, 1 to 4 from index to little finger.
        finger_column: (n,) int; number of the finger, 1 to 4, to whose columns a vertex of the palm belongs.
        plane_point, plane_normal: (n, 3), the plane of the ring of each vertex.
        plane_hold: (n,) 0 to 1, the fraction by which a vertex is kept in this plane.
        loose: (n,) bool, whether a vertex is placed between its neighbors before sculpting.
        sheet_positions: positions of the n vertices in sheets.
        sheets: (rows, columns) int, the vertices of each sheet; -1 at a hole.
    """

    points: np.ndarray
    faces: np.ndarray
    digit: np.ndarray
    finger_column: np.ndarray
    plane_point: np.ndarray
    plane_normal: np.ndarray
    plane_hold: np.ndarray
    loose: np.ndarray
    sheet_positions: list[SheetPosition]
    sheets: dict[str, np.ndarray]


class GridBuilder:
    """Builder that collects the vertices and faces of a grid."""

    def __init__(self):
        self.points: list[np.ndarray] = []
        self.faces: list[tuple[int, int, int, int]] = []
        self.digits_and_columns: list[tuple[int, int]] = []
        self.planes: list[tuple[np.ndarray, np.ndarray, float]] = []
        self.loose: list[bool] = []
        self.sheet_positions: list[SheetPosition] = []
        self.sheets: dict[str, list[list[int]]] = {}

    def add_vertex(
        self, point, sheet_position: SheetPosition, digit: int, finger_column: int, plane=None, loose: bool = False
    ) -> int:
        """Add a vertex, and return its index.

        Args:
            point: (3,) position, meters, arm space.
            sheet_position: position in a sheet.
            digit, finger_column, loose: as in `Grid`.
            plane: point, normal and hold of the plane of its ring; None for a vertex that is not in a ring.
        """
        point = np.asarray(point, float)
        self.points.append(point)
        self.sheet_positions.append(sheet_position)
        self.digits_and_columns.append((digit, finger_column))
        self.planes.append(plane if plane is not None else (point, np.array([1.0, 0.0, 0.0]), 0.0))
        self.loose.append(loose)
        return len(self.points) - 1

    def add_band(self, near: list[int], far: list[int], skip=()):
        """Add the faces between two closed rings, which run clockwise when viewed from beyond the far ring.

        Args:
            near, far: vertices of the rings.
            skip: columns that stay open.
        """
        for column in range(len(near)):
            next_column = (column + 1) % len(near)
            if column not in skip:
                self.faces.append((near[column], far[column], far[next_column], near[next_column]))

    def add_patch(self, rows: list[list[int]]):
        """Add the faces between open rows. Viewed from outside, rows run to the right, and each next row is below."""
        for upper_row, lower_row in pairwise(rows):
            for column in range(len(upper_row) - 1):
                self.faces.append((upper_row[column], lower_row[column], lower_row[column + 1], upper_row[column + 1]))

    def build(self) -> Grid:
        """Build the grid, without the unused vertices of the tube under the thumb."""
        used_vertices, faces = np.unique(np.array(self.faces), return_inverse=True)
        new_indices = np.full(len(self.points) + 1, -1)
        new_indices[used_vertices] = np.arange(len(used_vertices))
        digits_and_columns = np.array(self.digits_and_columns)[used_vertices]
        plane_points, plane_normals, holds = zip(*self.planes, strict=True)
        return Grid(
            points=np.array(self.points)[used_vertices],
            faces=faces.reshape(-1, 4).astype(np.int32),
            digit=digits_and_columns[:, 0],
            finger_column=digits_and_columns[:, 1],
            plane_point=np.array(plane_points)[used_vertices],
            plane_normal=np.array(plane_normals)[used_vertices],
            plane_hold=np.array(holds)[used_vertices],
            loose=np.array(self.loose)[used_vertices],
            sheet_positions=[self.sheet_positions[vertex_index] for vertex_index in used_vertices],
            sheets={name: new_indices[np.array(rows)] for name, rows in self.sheets.items()},
        )


def interpolate_guide_points(grid: Grid, guide: Grid, guide_points: np.ndarray) -> np.ndarray:
    """Interpolate the (n, 3) float64 points of a grid between points of a guide grid of density 1, sheet by sheet."""
    points = grid.points.copy()
    sheet_names = np.array([sheet_position.sheet for sheet_position in grid.sheet_positions])
    rows_and_columns = np.array(
        [(sheet_position.row, sheet_position.column) for sheet_position in grid.sheet_positions]
    )
    for name, vertices in guide.sheets.items():
        vertex_indices = np.flatnonzero(sheet_names == name)
        sheet_points = guide_points[vertices]
        row_count, column_count = sheet_points.shape[:2]
        positions = rows_and_columns[vertex_indices]
        row = np.clip(np.floor(positions[:, 0]).astype(int), 0, max(row_count - 2, 0))
        column = np.floor(positions[:, 1]).astype(int)
        row_fraction, column_fraction = (positions[:, 0] - row)[:, None], (positions[:, 1] - column)[:, None]
        # The last column of a closed sheet is next to the first; positions in an open sheet end at its last column.
        next_row, next_column = np.minimum(row + 1, row_count - 1), (column + 1) % column_count
        row_points = (
            sheet_points[row, column] * (1 - column_fraction) + sheet_points[row, next_column] * column_fraction
        )
        next_row_points = (
            sheet_points[next_row, column] * (1 - column_fraction)
            + sheet_points[next_row, next_column] * column_fraction
        )
        points[vertex_indices] = row_points * (1 - row_fraction) + next_row_points * row_fraction
    return points
