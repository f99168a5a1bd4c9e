# SPDX-License-Identifier: GPL-3.0-or-later
"""The tube of quads from the shoulder to the webs of the fingers.

Around it run the columns of a modeled hand: each finger's own on the back and on the palm, narrow web columns between
them, and two sides. An address counts them from the thumb's side across the back, down the little finger's side, back
across the palm and up the thumb's side.
"""

from itertools import pairwise

import numpy as np

from .field import cubic_curve
from .joints import FINGERS, HAND, UPPER_ARM_LENGTH, WRIST_X, joint
from .quads import DIVISIONS, Divisions, GridBuilder, SheetPosition

# x and the spacing of rings wanted there, meters: close at the elbow, the wrist and in the hand.
_SPACING = np.array(
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
# Rings of density 1: from which the thumb grows, and over the knuckles.
_GUIDE_ROOT, _GUIDE_KNUCKLES = 29, 34


class Tube:
    """Addresses and rings of one density, and their positions in density 1."""

    def __init__(self, divisions: Divisions):
        d = self.divisions = divisions
        self.top = 4 * d.finger + 3 * d.web
        self.around = 2 * self.top + 2 * d.side
        self.guide_column = self._guide_columns()
        self.guide_ring, self.root = self._guide_rings()

    def finger_start(self, k: int) -> int:
        """First column on the back of finger k = 1..4."""
        return (k - 1) * (self.divisions.finger + self.divisions.web)

    def palm(self, column: int) -> int:
        """Return the address on the palm under a column of the back."""
        return 2 * self.top + self.divisions.side - column

    def side(self, j: int) -> int:
        """Return the address j = 0 (back) .. divisions.side (palm) down the thumb's side."""
        return 0 if j == 0 else self.around - j

    def column_of(self, address: int) -> int:
        """Return the column of the back, 0..top, over or at an address; the sides belong to the nearest."""
        if address <= self.top:
            return address
        return int(np.clip(self.palm(address), 0, self.top))

    def finger_of(self, address: int) -> int:
        """Return the finger 1..4 in whose columns an address runs, a web's being shared."""
        d = self.divisions
        block, inside = divmod(self.column_of(address), d.finger + d.web)
        return min(block + 1 + (inside - d.finger > d.web / 2), 4)

    def _guide_columns(self) -> np.ndarray:
        """(around,) address in density 1 of every address."""
        d, g = self.divisions, DIVISIONS[1]
        back = [(d.finger, g.finger), (d.web, g.web)] * 3 + [(d.finger, g.finger)]
        parts = [*back, (d.side, g.side), *back, (d.side, g.side)]
        mine, guide = (np.concatenate([[0], np.cumsum(counts)]) for counts in zip(*parts, strict=True))
        return np.interp(np.arange(self.around), mine, guide)

    def _guide_rings(self) -> tuple[np.ndarray, int]:
        """(rings + 1,) ring in density 1 of every ring, and the ring where the thumb's root begins."""
        d, g = self.divisions, DIVISIONS[1]
        mine, guide = _landmark_rings(d.rings), _landmark_rings(g.rings)
        rings = np.interp(np.arange(mine[-1] + 1), mine, guide)
        root = int(np.argmin(np.abs(rings - _GUIDE_ROOT)))
        mine = np.insert(mine, 3, (root, root + d.thumb_root))
        guide = np.insert(guide, 3, (_GUIDE_ROOT, _GUIDE_ROOT + g.thumb_root))
        return np.interp(np.arange(mine[-1] + 1), mine, guide), root


def _landmark_rings(rings: tuple[int, int, int]) -> np.ndarray:
    """Return the ring indices of start, elbow, wrist and webs; elbow and wrist are between two rings."""
    to_elbow, to_wrist, to_web = rings
    return np.array([0.0, to_elbow - 0.5, to_elbow + to_wrist - 0.5, to_elbow + to_wrist + to_web])


def _ring_positions(ring: np.ndarray) -> np.ndarray:
    """Compute x of rings, indexed as in density 1."""
    fine = np.linspace(_START_X, _END_X, 4001)
    density = 1.0 / np.interp(fine, _SPACING[:, 0], _SPACING[:, 1])
    count = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(fine))])
    at = np.interp([_START_X, UPPER_ARM_LENGTH, WRIST_X, _END_X], fine, count)
    # A smooth map from ring number to count keeps neighboring spacings alike across the joints.
    return np.interp(cubic_curve(ring, _landmark_rings(DIVISIONS[1].rings), at[:, None])[:, 0], count, fine)


def _hand_columns(tube: Tube) -> np.ndarray:
    """(top + 1,) y of the columns at the webs: fingers around their bones, webs between."""
    d = tube.divisions
    places = np.zeros(tube.top + 1)
    for k, name in enumerate(FINGERS, start=1):
        bone = joint(f"{name}_1")
        middle = (bone.head[1] + bone.tail[1]) / 2
        half = {"index": 0.0084, "middle": 0.0084, "ring": 0.0080, "pinky": 0.0072}[name]
        start = tube.finger_start(k)
        places[start : start + d.finger + 1] = np.linspace(middle - half, middle + half, d.finger + 1)
    for k in range(1, 4):
        a, b = tube.finger_start(k) + d.finger, tube.finger_start(k + 1)
        places[a : b + 1] = np.linspace(places[a], places[b], d.web + 1)
    return places


def _hand_x(ring: float, x: float, y: np.ndarray) -> np.ndarray:
    """Return x of one ring, `ring` in the numbers of density 1, at the side places y.

    Past the wrist the rings bend, so that one runs over the knuckles and the last one through the webs; both fall back
    to the little finger.
    """
    wrist, knuckles, webs = (
        _landmark_rings(DIVISIONS[1].rings)[2],
        _GUIDE_KNUCKLES,
        _landmark_rings(DIVISIONS[1].rings)[3],
    )
    if ring <= wrist:
        return np.full(len(y), x)
    knuckle_x = np.interp(y, *np.array([HAND[name].knuckle[1::-1] for name in FINGERS]).T)
    web_x = np.interp(y, (-0.033, -0.020, 0.003, 0.0255, 0.040), (0.664, 0.6680, 0.6680, 0.6580, 0.648))
    if ring <= knuckles:
        return WRIST_X + (knuckle_x - WRIST_X) * ((ring - wrist) / (knuckles - wrist))
    return knuckle_x + (web_x - knuckle_x) * ((ring - knuckles) / (webs - knuckles))


def _outlines(tube: Tube) -> tuple[np.ndarray, np.ndarray]:
    """(around, 2) places y, z of the addresses: around a circle of radius 1, and in the hand, meters."""
    d, columns = tube.divisions, _hand_columns(tube)
    corner = np.pi * 0.22
    angle, hand = np.zeros(tube.around), np.zeros((tube.around, 2))
    for column in range(tube.top + 1):
        along = column / tube.top * (np.pi - 2 * corner)
        angle[column], angle[tube.palm(column)] = np.pi - corner - along, np.pi + corner + along
        hand[column] = hand[tube.palm(column)] = columns[column], 0.017
    for j in range(1, d.side):
        s = j / d.side
        angle[tube.top + j], angle[tube.side(j)] = corner * (1 - 2 * s), np.pi - corner * (1 - 2 * s)
        hand[tube.top + j] = columns[-1] + 0.003 * np.sin(np.pi * s), 0.017 * (1 - 2 * s)
        hand[tube.side(j)] = columns[0] - 0.003 * np.sin(np.pi * s), 0.017 * (1 - 2 * s)
    palm = [tube.palm(column) for column in range(tube.top + 1)]
    hand[palm, 1] *= -1.0
    return np.stack([np.cos(angle), np.sin(angle)], axis=1), hand


def lay_tube(quads: GridBuilder, tube: Tube) -> list[list[int]]:
    """Add vertices and faces of the tube, without those under the thumb, and close the shoulder."""
    d = tube.divisions
    circle, hand = _outlines(tube)
    axis = np.array([1.0, 0.0, 0.0])
    fingers = [tube.finger_of(address) for address in range(tube.around)]
    rings = []
    for number, x in enumerate(_ring_positions(tube.guide_ring)):
        in_hand = float(np.clip((x - WRIST_X) / (_END_X - WRIST_X), 0.0, 1.0))
        spread = in_hand * in_hand * (3 - 2 * in_hand)
        radius = 0.045 if x < 0.4 else 0.03
        place = circle * radius * (1 - spread) + hand * spread
        # Before the second ring of density 1 the end of the arm is rounded off, with no planes to keep to.
        edge = 1.0 - min(float(tube.guide_ring[number]), 1.0)
        place = place * (1.0 - 0.3 * edge)
        ring_x = _hand_x(float(tube.guide_ring[number]), x, place[:, 0])
        ring = []
        for address in range(tube.around):
            point = np.array([ring_x[address], *place[address]])
            sheet_position = SheetPosition("tube", float(tube.guide_ring[number]), float(tube.guide_column[address]))
            loose = 0.566 < x < 0.650 and point[1] < -0.005
            # In the hand the rings are left freer: they find their way between wrist, thumb and webs.
            free = np.clip((x - 0.565) / 0.03, 0.0, 1.0) * (0.95 if point[1] < 0.0 and x < 0.64 else 0.6)
            hold = 0.0 if edge > 0.0 else 1.0 - float(free)
            ring.append(quads.vertex(point, sheet_position, -1, fingers[address], (point, axis, hold), loose))
        rings.append(ring)
    quads.sheets["tube"] = rings
    root = range(tube.root, tube.root + d.thumb_root)
    for number, (near, far) in enumerate(pairwise(rings)):
        quads.band(near, far, skip=range(tube.palm(0), tube.around) if number in root else ())
    _close_shoulder(quads, tube, rings[0])
    return rings


def _close_shoulder(quads: GridBuilder, tube: Tube, first: list[int]):
    """Close the shoulder by joining the columns of the back to those of the palm."""
    d = tube.divisions
    rows = [first[: tube.top + 1]]
    for j in range(1, d.side):
        left, right = first[tube.side(j)], first[tube.top + j]
        row = [left]
        for column in range(1, tube.top):
            t = column / tube.top
            point = quads.points[left] * (1 - t) + quads.points[right] * t
            sheet_position = SheetPosition("shoulder", j * DIVISIONS[1].side / d.side, float(tube.guide_column[column]))
            row.append(quads.vertex(point, sheet_position, -1, tube.finger_of(column)))
        rows.append([*row, right])
    rows.append([first[tube.palm(column)] for column in range(tube.top + 1)])
    quads.sheets["shoulder"] = rows
    quads.patch([row[::-1] for row in rows])
