# SPDX-License-Identifier: GPL-3.0-or-later
"""Builds the tube of quads from the shoulder to the webs of the fingers.

The columns of the tube are arranged as in a modeled hand: each finger has columns on the back and on the palm. Between
them are narrow columns for the webs, and there are two sides. A loop index counts the vertices of a ring: across the
back from the side of the thumb, down the side of the little finger, back across the palm, and up the side of the thumb.
"""

from itertools import pairwise

import numpy as np

from .field import cubic_curve
from .joints import FINGER_MEASURES, FINGERS, UPPER_ARM_LENGTH, WRIST_X, joint
from .quads import DIVISIONS, Divisions, GridBuilder, SheetPosition

# Position x, and the spacing of rings there, meters. Rings are close together at the elbow, the wrist and in the hand.
_RING_SPACING = np.array(
    [
        (-0.030, 0.017),
        (0.020, 0.022),
        (0.110, 0.026),
        (0.220, 0.021),
        (0.275, 0.014),
        (0.325, 0.014),
        (0.390, 0.024),
        (0.480, 0.026),
        (0.530, 0.014),
        (0.570, 0.0105),
        (0.675, 0.0115),
    ]
)
_START_X, _END_X = -0.036, 0.668
# Rings of density 1: the first ring of the thumb's root, and the ring over the knuckles.
_GUIDE_ROOT_RING, _GUIDE_KNUCKLE_RING = 29, 34


class Tube:
    """Layout of the tube at one density: loop indices and rings, and their positions in density 1.

    Attributes:
        divisions: numbers of faces.
        top: loop index of the last column of the back.
        around: number of vertices in a ring.
        guide_column: (around,) loop index in density 1 of each vertex of a ring.
        guide_ring: ring index in density 1 of each ring.
        root: index of the ring where the root of the thumb begins.
    """

    def __init__(self, divisions: Divisions):
        d = self.divisions = divisions
        self.top = 4 * d.finger + 3 * d.web
        self.around = 2 * self.top + 2 * d.side
        self.guide_column = self._guide_columns()
        self.guide_ring, self.root = self._guide_rings()

    def finger_start(self, finger_number: int) -> int:
        """Return the first column on the back of a finger, 1 to 4."""
        return (finger_number - 1) * (self.divisions.finger + self.divisions.web)

    def palm(self, column: int) -> int:
        """Return the loop index on the palm under a column of the back."""
        return 2 * self.top + self.divisions.side - column

    def side(self, row: int) -> int:
        """Return the loop index of a row on the thumb's side, from 0 (back) to `divisions.side` (palm)."""
        return 0 if row == 0 else self.around - row

    def column_of(self, loop_index: int) -> int:
        """Return the column of the back, 0 to `top`, over a loop index; the sides belong to the nearest column."""
        if loop_index <= self.top:
            return loop_index
        return int(np.clip(self.palm(loop_index), 0, self.top))

    def finger_of(self, loop_index: int) -> int:
        """Return the finger, 1 to 4, to whose columns a loop index belongs; a web belongs half to each finger."""
        d = self.divisions
        finger_block, column_in_block = divmod(self.column_of(loop_index), d.finger + d.web)
        return min(finger_block + 1 + (column_in_block - d.finger > d.web / 2), 4)

    def _guide_columns(self) -> np.ndarray:
        """Return the loop index in density 1 of each loop index, (around,) float64."""
        divisions, guide_divisions = self.divisions, DIVISIONS[1]
        back_counts = [(divisions.finger, guide_divisions.finger), (divisions.web, guide_divisions.web)] * 3 + [
            (divisions.finger, guide_divisions.finger)
        ]
        face_counts = [
            *back_counts,
            (divisions.side, guide_divisions.side),
            *back_counts,
            (divisions.side, guide_divisions.side),
        ]
        loop_boundaries, guide_boundaries = (
            np.concatenate([[0], np.cumsum(counts)]) for counts in zip(*face_counts, strict=True)
        )
        return np.interp(np.arange(self.around), loop_boundaries, guide_boundaries)

    def _guide_rings(self) -> tuple[np.ndarray, int]:
        """Return the ring index in density 1 of each ring, (rings + 1,), and the first ring of the thumb's root."""
        divisions, guide_divisions = self.divisions, DIVISIONS[1]
        ring_landmarks, guide_landmarks = _landmark_rings(divisions.rings), _landmark_rings(guide_divisions.rings)
        rings = np.interp(np.arange(ring_landmarks[-1] + 1), ring_landmarks, guide_landmarks)
        root = int(np.argmin(np.abs(rings - _GUIDE_ROOT_RING)))
        ring_landmarks = np.insert(ring_landmarks, 3, (root, root + divisions.thumb_root))
        guide_landmarks = np.insert(
            guide_landmarks, 3, (_GUIDE_ROOT_RING, _GUIDE_ROOT_RING + guide_divisions.thumb_root)
        )
        return np.interp(np.arange(ring_landmarks[-1] + 1), ring_landmarks, guide_landmarks), root


def _landmark_rings(rings: tuple[int, int, int]) -> np.ndarray:
    """Return the ring indices of shoulder, elbow, wrist and webs; elbow and wrist are between two rings."""
    to_elbow, to_wrist, to_web = rings
    return np.array([0.0, to_elbow - 0.5, to_elbow + to_wrist - 0.5, to_elbow + to_wrist + to_web])


def _ring_positions(ring_indices: np.ndarray) -> np.ndarray:
    """Compute the position x of rings, given by their (possibly fractional) indices in density 1."""
    fine_x = np.linspace(_START_X, _END_X, 4001)
    density = 1.0 / np.interp(fine_x, _RING_SPACING[:, 0], _RING_SPACING[:, 1])
    integrated_density = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(fine_x))])
    landmark_density = np.interp([_START_X, UPPER_ARM_LENGTH, WRIST_X, _END_X], fine_x, integrated_density)
    # A smooth function from ring index to the integrated density keeps the spacing smooth across the joints.
    return np.interp(
        cubic_curve(ring_indices, _landmark_rings(DIVISIONS[1].rings), landmark_density[:, None])[:, 0],
        integrated_density,
        fine_x,
    )


def _hand_columns(tube: Tube) -> np.ndarray:
    """Return the position y of the columns at the webs, (top + 1,): fingers are around their bones, webs between."""
    divisions = tube.divisions
    column_y = np.zeros(tube.top + 1)
    for finger_number, name in enumerate(FINGERS, start=1):
        bone = joint(f"{name}_1")
        center = (bone.head[1] + bone.tail[1]) / 2
        half_width = {"index": 0.0084, "middle": 0.0084, "ring": 0.0080, "pinky": 0.0072}[name]
        start = tube.finger_start(finger_number)
        column_y[start : start + divisions.finger + 1] = np.linspace(
            center - half_width, center + half_width, divisions.finger + 1
        )
    for finger_number in range(1, 4):
        web_start, web_end = tube.finger_start(finger_number) + divisions.finger, tube.finger_start(finger_number + 1)
        column_y[web_start : web_end + 1] = np.linspace(column_y[web_start], column_y[web_end], divisions.web + 1)
    return column_y


def _hand_x(ring: float, x: float, y: np.ndarray) -> np.ndarray:
    """Return the position x of one ring, given by its index in density 1, at the positions y of its vertices.

    Past the wrist the rings are bent, so that one passes over the knuckles and the last one through the webs. Both are
    closer to the wrist at the little finger.
    """
    wrist, knuckles, webs = (
        _landmark_rings(DIVISIONS[1].rings)[2],
        _GUIDE_KNUCKLE_RING,
        _landmark_rings(DIVISIONS[1].rings)[3],
    )
    if ring <= wrist:
        return np.full(len(y), x)
    knuckle_x = np.interp(y, *np.array([FINGER_MEASURES[name].knuckle[1::-1] for name in FINGERS]).T)
    web_x = np.interp(y, (-0.033, -0.020, 0.003, 0.0255, 0.040), (0.664, 0.6680, 0.6680, 0.6580, 0.648))
    if ring <= knuckles:
        return WRIST_X + (knuckle_x - WRIST_X) * ((ring - wrist) / (knuckles - wrist))
    return knuckle_x + (web_x - knuckle_x) * ((ring - knuckles) / (webs - knuckles))


def _outlines(tube: Tube) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions y, z by loop index, (around, 2): on a circle of radius 1, and in the hand, meters."""
    divisions, column_y = tube.divisions, _hand_columns(tube)
    corner_angle = np.pi * 0.22
    angles, hand_positions = np.zeros(tube.around), np.zeros((tube.around, 2))
    for column in range(tube.top + 1):
        angle_from_corner = column / tube.top * (np.pi - 2 * corner_angle)
        angles[column], angles[tube.palm(column)] = (
            np.pi - corner_angle - angle_from_corner,
            np.pi + corner_angle + angle_from_corner,
        )
        hand_positions[column] = hand_positions[tube.palm(column)] = column_y[column], 0.017
    for row in range(1, divisions.side):
        fraction = row / divisions.side
        angles[tube.top + row], angles[tube.side(row)] = (
            corner_angle * (1 - 2 * fraction),
            np.pi - corner_angle * (1 - 2 * fraction),
        )
        hand_positions[tube.top + row] = column_y[-1] + 0.003 * np.sin(np.pi * fraction), 0.017 * (1 - 2 * fraction)
        hand_positions[tube.side(row)] = column_y[0] - 0.003 * np.sin(np.pi * fraction), 0.017 * (1 - 2 * fraction)
    palm_indices = [tube.palm(column) for column in range(tube.top + 1)]
    hand_positions[palm_indices, 1] *= -1.0
    return np.stack([np.cos(angles), np.sin(angles)], axis=1), hand_positions


def add_tube(quads: GridBuilder, tube: Tube) -> list[list[int]]:
    """Add the tube without faces under the thumb, close the shoulder, and return the vertices of each ring."""
    divisions = tube.divisions
    circle_outline, hand_outline = _outlines(tube)
    axis = np.array([1.0, 0.0, 0.0])
    fingers = [tube.finger_of(loop_index) for loop_index in range(tube.around)]
    rings = []
    for ring_index, x in enumerate(_ring_positions(tube.guide_ring)):
        hand_fraction = float(np.clip((x - WRIST_X) / (_END_X - WRIST_X), 0.0, 1.0))
        hand_weight = hand_fraction * hand_fraction * (3 - 2 * hand_fraction)
        radius = 0.045 if x < 0.4 else 0.03
        outline = circle_outline * radius * (1 - hand_weight) + hand_outline * hand_weight
        # Before the second ring of density 1, the end of the arm is round, and vertices are not kept in planes.
        end_rounding = 1.0 - min(float(tube.guide_ring[ring_index]), 1.0)
        outline = outline * (1.0 - 0.3 * end_rounding)
        ring_x = _hand_x(float(tube.guide_ring[ring_index]), x, outline[:, 0])
        ring = []
        for loop_index in range(tube.around):
            point = np.array([ring_x[loop_index], *outline[loop_index]])
            sheet_position = SheetPosition(
                "tube", float(tube.guide_ring[ring_index]), float(tube.guide_column[loop_index])
            )
            is_loose = 0.566 < x < 0.650 and point[1] < -0.005
            # In the hand, vertices are kept in their planes less strictly, so that relaxation can bend the rings.
            plane_freedom = np.clip((x - 0.565) / 0.03, 0.0, 1.0) * (0.95 if point[1] < 0.0 and x < 0.64 else 0.6)
            plane_hold = 0.0 if end_rounding > 0.0 else 1.0 - float(plane_freedom)
            ring.append(
                quads.add_vertex(point, sheet_position, -1, fingers[loop_index], (point, axis, plane_hold), is_loose)
            )
        rings.append(ring)
    quads.sheets["tube"] = rings
    root_rings = range(tube.root, tube.root + divisions.thumb_root)
    for ring_index, (near, far) in enumerate(pairwise(rings)):
        quads.add_band(near, far, skip=range(tube.palm(0), tube.around) if ring_index in root_rings else ())
    # Close the shoulder by connecting the columns of the back to the columns of the palm.
    first_ring = rings[0]
    divisions = tube.divisions
    rows = [first_ring[: tube.top + 1]]
    for row_index in range(1, divisions.side):
        left_vertex, right_vertex = first_ring[tube.side(row_index)], first_ring[tube.top + row_index]
        row = [left_vertex]
        for column in range(1, tube.top):
            fraction = column / tube.top
            point = quads.points[left_vertex] * (1 - fraction) + quads.points[right_vertex] * fraction
            sheet_position = SheetPosition(
                "shoulder", row_index * DIVISIONS[1].side / divisions.side, float(tube.guide_column[column])
            )
            row.append(quads.add_vertex(point, sheet_position, -1, tube.finger_of(column)))
        rows.append([*row, right_vertex])
    rows.append([first_ring[tube.palm(column)] for column in range(tube.top + 1)])
    quads.sheets["shoulder"] = rows
    quads.add_patch([row[::-1] for row in rows])
    return rings
