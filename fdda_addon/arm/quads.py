# SPDX-License-Identifier: GPL-3.0-or-later
"""Quad grids in sheets: subdivision, construction, and interpolation from a coarser grid."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np


@dataclass(frozen=True)
class Divisions:
    """Numbers of faces in each direction.

    finger, web, side: across a finger, a web, and the side of the hand. rings: along the arm to the elbow, on to the
    wrist, on to the webs. finger_rings, thumb_rings: along a finger from the webs, along the thumb. thumb_root: along
    the hand where the thumb grows out of it.
    """

    finger: int
    web: int
    side: int
    rings: tuple[int, int, int]
    finger_rings: int
    thumb_root: int
    thumb_rings: int


# Density 1 is also the guide from which the finer ones are seeded.
DIVISIONS = {
    1: Divisions(2, 1, 2, (15, 11, 10), 12, 3, 11),
    2: Divisions(5, 3, 5, (39, 30, 26), 31, 8, 28),
    3: Divisions(12, 6, 12, (86, 66, 58), 66, 18, 60),
}


@dataclass(frozen=True)
class SheetPosition:
    """Where a vertex sits in a sheet, counted in the faces of density 1."""

    sheet: str
    row: float
    column: float


@dataclass
class Grid:
    """Unsculpted quads.

    points: (n, 3) float64, meters, arm space. faces: (f, 4) int32, outward.
    digit: (n,) int, -1 for arm and palm, else 0 for the thumb, 1..4 from index to little finger.
    column: (n,) int, in the palm the finger 1..4 in whose columns a vertex runs.
    plane_point, plane_normal (n, 3), plane_hold (n,) 0..1: the plane of a vertex's ring, and how firmly it keeps to it.
    loose: (n,) bool, to be drawn out between its neighbors before anything else.
    sheet_positions: n of them. sheets: vertices of each sheet, (rows, columns) int, -1 where it has a hole.
    """

    points: np.ndarray
    faces: np.ndarray
    digit: np.ndarray
    column: np.ndarray
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
        self.marks: list[tuple[int, int]] = []
        self.planes: list[tuple[np.ndarray, np.ndarray, float]] = []
        self.loose: list[bool] = []
        self.sheet_positions: list[SheetPosition] = []
        self.sheets: dict[str, list[list[int]]] = {}

    def vertex(
        self, point, sheet_position: SheetPosition, digit: int, column: int, plane=None, loose: bool = False
    ) -> int:
        """plane: (point, normal, hold); None for a vertex that is in no ring."""
        point = np.asarray(point, float)
        self.points.append(point)
        self.sheet_positions.append(sheet_position)
        self.marks.append((digit, column))
        self.planes.append(plane if plane is not None else (point, np.array([1.0, 0.0, 0.0]), 0.0))
        self.loose.append(loose)
        return len(self.points) - 1

    def band(self, near: list[int], far: list[int], skip=()):
        """Faces between two closed rings that run clockwise seen from beyond the far one; `skip`: columns left open."""
        for i in range(len(near)):
            k = (i + 1) % len(near)
            if i not in skip:
                self.faces.append((near[i], far[i], far[k], near[k]))

    def patch(self, rows: list[list[int]]):
        """Faces between open rows; seen from outside, the rows run to the right and follow each other downwards."""
        for a, b in pairwise(rows):
            for i in range(len(a) - 1):
                self.faces.append((a[i], b[i], b[i + 1], a[i + 1]))

    def grid(self) -> Grid:
        """Return the grid without unused vertices, which the tube has under the thumb."""
        used, faces = np.unique(np.array(self.faces), return_inverse=True)
        number = np.full(len(self.points) + 1, -1)
        number[used] = np.arange(len(used))
        marks = np.array(self.marks)[used]
        plane_points, plane_normals, holds = zip(*self.planes, strict=True)
        return Grid(
            points=np.array(self.points)[used],
            faces=faces.reshape(-1, 4).astype(np.int32),
            digit=marks[:, 0],
            column=marks[:, 1],
            plane_point=np.array(plane_points)[used],
            plane_normal=np.array(plane_normals)[used],
            plane_hold=np.array(holds)[used],
            loose=np.array(self.loose)[used],
            sheet_positions=[self.sheet_positions[i] for i in used],
            sheets={name: number[np.array(rows)] for name, rows in self.sheets.items()},
        )


def interpolate_guide_points(grid: Grid, guide: Grid, guide_points: np.ndarray) -> np.ndarray:
    """Interpolate the (n, 3) float64 points of `grid` between those of a guide grid of density 1, sheet by sheet."""
    points = grid.points.copy()
    names = np.array([sheet_position.sheet for sheet_position in grid.sheet_positions])
    places = np.array([(sheet_position.row, sheet_position.column) for sheet_position in grid.sheet_positions])
    for name, vertices in guide.sheets.items():
        mine = np.flatnonzero(names == name)
        sheet = guide_points[vertices]
        rows, columns = sheet.shape[:2]
        at = places[mine]
        row = np.clip(np.floor(at[:, 0]).astype(int), 0, max(rows - 2, 0))
        column = np.floor(at[:, 1]).astype(int)
        s, t = (at[:, 0] - row)[:, None], (at[:, 1] - column)[:, None]
        # A closed sheet goes round; in an open one the last column is never passed.
        below, right = np.minimum(row + 1, rows - 1), (column + 1) % columns
        near = sheet[row, column] * (1 - t) + sheet[row, right] * t
        far = sheet[below, column] * (1 - t) + sheet[below, right] * t
        points[mine] = near * (1 - s) + far * s
    return points
