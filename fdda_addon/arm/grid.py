# SPDX-License-Identifier: GPL-3.0-or-later
"""The quads of the arm before they are sculpted: one tube from shoulder to webs, five tubes for the fingers.

Around the tube run the columns of a modelled hand: each finger's own columns on the back and on the palm, narrow web
columns between them, and two sides. Every finger grows out of the end of its columns, the thumb out of the radial side.
A vertex is a row of `Grid.points`; `plane_point`, `plane_normal` and `plane_hold` say which plane it belongs to (its
ring), so that rings stay square to the bones while the grid is relaxed onto the surface.
"""

from dataclasses import dataclass

import numpy as np

from .field import frame_along, smooth_curve
from .joints import FINGERS, HAND, UPPER_ARM_LENGTH, WRIST_X, joint

DENSITIES = (1, 2, 3)


@dataclass(frozen=True)
class Divisions:
    """How many faces: per finger width, web, side; rings before the elbow, to the wrist, to the webs; fingers, thumb."""

    finger: int
    web: int
    side: int
    rings: tuple[int, int, int]
    finger_rings: int
    thumb_root: int
    thumb_rings: int


DIVISIONS = {
    1: Divisions(2, 1, 2, (15, 12, 10), 11, 3, 10),
    2: Divisions(5, 3, 5, (40, 31, 26), 29, 8, 26),
    3: Divisions(12, 6, 12, (87, 70, 58), 64, 18, 58),
}

# x and the spacing of rings wanted there, metres: close at the elbow, the wrist and in the hand.
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
_START_X, _WEB_X = -0.028, 0.674
# Where a finger leaves the hand, as a part of its first phalanx: on the back, at the webs, in the palm.
_LEAVES = (0.34, 0.50, 0.50)


@dataclass
class Grid:
    """points (n, 3) float64, metres; faces (f, 4) int32, outward; finger (n,) int: -1 for the arm and palm, else 0 thumb,
    1..4 index to little finger; column (n,) int: the finger 1..4 whose columns a vertex of the tube runs in."""

    points: np.ndarray
    faces: np.ndarray
    finger: np.ndarray
    column: np.ndarray
    plane_point: np.ndarray
    plane_normal: np.ndarray
    plane_hold: np.ndarray


def _ring_places(divisions: Divisions) -> np.ndarray:
    """(rings + 1,) x of every ring; the elbow and the wrist lie half way between two rings."""
    fine = np.linspace(_START_X, _WEB_X, 4001)
    density = 1.0 / np.interp(fine, _SPACING[:, 0], _SPACING[:, 1])
    count = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(fine))])
    at = np.interp([UPPER_ARM_LENGTH, WRIST_X], fine, count)
    to_elbow, to_wrist, to_web = divisions.rings
    marks = np.array([0.0, at[0], at[1], count[-1]])
    wanted = np.array([0.0, to_elbow - 0.5, to_elbow + to_wrist - 0.5, to_elbow + to_wrist + to_web])
    index = np.arange(wanted[-1] + 1)
    # A smooth map from ring number to count keeps neighbouring spacings alike across the marks.
    mapped = smooth_curve(index, wanted, marks[:, None])[:, 0]
    return np.interp(mapped, count, fine)


class _Builder:
    """Collects vertices and faces."""

    def __init__(self):
        self.points: list[np.ndarray] = []
        self.faces: list[tuple[int, int, int, int]] = []
        self.finger: list[int] = []
        self.column: list[int] = []
        self.planes: list[tuple[np.ndarray, np.ndarray, float]] = []

    def vertex(self, point, finger: int, column: int, plane_point, plane_normal, hold: float) -> int:
        self.points.append(np.asarray(point, float))
        self.finger.append(finger)
        self.column.append(column)
        self.planes.append((np.asarray(plane_point, float), np.asarray(plane_normal, float), hold))
        return len(self.points) - 1

    def grid(self) -> Grid:
        """What was collected, without the vertices that no face uses (the tube's, under the thumb)."""
        used, faces = np.unique(np.array(self.faces), return_inverse=True)
        plane_points, plane_normals, holds = zip(*self.planes)
        return Grid(
            points=np.array(self.points)[used],
            faces=faces.reshape(-1, 4).astype(np.int32),
            finger=np.array(self.finger)[used],
            column=np.array(self.column)[used],
            plane_point=np.array(plane_points)[used],
            plane_normal=np.array(plane_normals)[used],
            plane_hold=np.array(holds)[used],
        )

    def strip(self, near: list[int], far: list[int]):
        """Faces between two rings that run clockwise seen from the far side (outward normals)."""
        n = len(near)
        for i in range(n):
            k = (i + 1) % n
            self.faces.append((near[i], far[i], far[k], near[k]))

    def patch(self, rows: list[list[int]]):
        for a, b in zip(rows, rows[1:]):
            for i in range(len(a) - 1):
                self.faces.append((a[i], b[i], b[i + 1], a[i + 1]))


class _Tube:
    """Addresses around the tube: 0..top across the back from thumb to little finger, down the ulnar side, back across
    the palm, up the radial side."""

    def __init__(self, d: Divisions):
        self.d = d
        self.top = 4 * d.finger + 3 * d.web
        self.around = 2 * self.top + 2 * d.side
        self.column_finger = []
        for i in range(self.top + 1):
            block, inside = divmod(i, d.finger + d.web)
            in_web = inside - d.finger
            self.column_finger.append(min(block + 1 + (in_web > d.web / 2), 4))

    def finger_start(self, k: int) -> int:
        """First column on the back of finger k = 1..4."""
        return (k - 1) * (self.d.finger + self.d.web)

    def palm(self, i: int) -> int:
        """The address on the palm side under column i of the back."""
        return self.top + self.d.side + (self.top - i)

    def finger_of(self, address: int) -> int:
        if address <= self.top:
            return self.column_finger[address]
        if address < self.palm(self.top):
            return 4
        if address <= self.palm(0):
            return self.column_finger[self.top - (address - self.top - self.d.side)]
        return 1


def _column_places(tube: _Tube) -> np.ndarray:
    """(top + 1,) y of the columns at the webs: finger blocks around their bones, webs between."""
    d = tube.d
    places = np.zeros(tube.top + 1)
    for k, name in enumerate(FINGERS, start=1):
        head, tail = np.array(joint(f"{name}_1").head), np.array(joint(f"{name}_1").tail)
        middle = (head * 0.5 + tail * 0.5)[1]
        half = {"index": 0.0084, "middle": 0.0084, "ring": 0.0080, "pinky": 0.0072}[name]
        start = tube.finger_start(k)
        places[start : start + d.finger + 1] = np.linspace(middle - half, middle + half, d.finger + 1)
    for k in range(1, 4):
        a, b = tube.finger_start(k) + d.finger, tube.finger_start(k + 1)
        places[a : b + 1] = np.linspace(places[a], places[b], d.web + 1)
    return places


def _web_x(y: float) -> float:
    """x where the fingers part, at the side place y: the line of the webs falls back to the little finger."""
    places = []
    for name in FINGERS:
        head, tail = np.array(joint(f"{name}_1").head), np.array(joint(f"{name}_1").tail)
        places.append(head + (tail - head) * _LEAVES[1])
    places = np.array(places)
    return float(np.interp(y, places[:, 1], places[:, 0]))


def _build_tube(b: _Builder, tube: _Tube, places: np.ndarray) -> list[list[int]]:
    d = tube.d
    columns = _column_places(tube)
    corner = np.pi * 0.22
    rings = []
    for x in places:
        in_hand = np.clip((x - WRIST_X) / (_WEB_X - WRIST_X), 0.0, 1.0)
        spread = in_hand * in_hand * (3 - 2 * in_hand)
        ring = []
        for address in range(tube.around):
            if address <= tube.top:
                t, row = address / tube.top, 1.0
                y_hand = columns[address]
                angle = np.pi - corner - t * (np.pi - 2 * corner)
            elif address < tube.palm(tube.top):
                s = (address - tube.top) / d.side
                row, y_hand = 1.0 - 2.0 * s, columns[-1] + 0.003 * np.sin(np.pi * s)
                angle = corner - s * 2 * corner
            elif address <= tube.palm(0):
                i = tube.top - (address - tube.palm(tube.top))
                t, row = i / tube.top, -1.0
                y_hand = columns[i]
                angle = np.pi + corner + t * (np.pi - 2 * corner)
            else:
                s = (address - tube.palm(0)) / d.side
                row, y_hand = -1.0 + 2.0 * s, columns[0] - 0.003 * np.sin(np.pi * s)
                angle = np.pi + corner - s * 2 * corner
            radius = 0.045 if x < 0.4 else 0.03
            round_y, round_z = radius * np.cos(angle), radius * np.sin(angle)
            y = round_y * (1 - spread) + y_hand * spread
            z = round_z * (1 - spread) + 0.010 * row * spread
            ring_x = x + in_hand * (_web_x(y) - _WEB_X)
            hold = 1.0 if x < WRIST_X + 0.01 else 1.0 - 0.85 * in_hand
            ring.append(b.vertex((ring_x, y, z), -1, tube.finger_of(address), (ring_x, y, z), (1, 0, 0), hold))
        rings.append(ring)
    return rings


def _finger_rings(name: str, count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """(point on the axis, unit axis) of the rings beyond the webs: close at the joints, the last just before the tip."""
    bones = [joint(f"{name}_{i}") for i in ((1, 2, 3) if name != "thumb" else (0, 1, 2))]
    heads = [np.array(bone.head) for bone in bones]
    heads.append(np.array(bones[-1].tail))
    # Part of the bone (0..3 along the three bones) at each of the eleven rings of density 1; the web is ring 0.
    if name == "thumb":
        knots = [0.48, 0.62, 0.76, 0.92, 1.13, 1.37, 1.62, 1.86, 2.13, 2.48, 2.88]
    else:
        knots = [0.50, 0.64, 0.78, 0.91, 1.13, 1.38, 1.64, 1.87, 2.15, 2.43, 2.71, 2.95]
    index = np.linspace(0.0, 1.0, count + 1)
    parts = smooth_curve(index, np.linspace(0.0, 1.0, len(knots)), np.array(knots)[:, None])[:, 0]
    axes = [(heads[i + 1] - heads[i]) / np.linalg.norm(heads[i + 1] - heads[i]) for i in range(3)]
    rings = []
    for part in parts[1:]:
        i = min(int(part), 2)
        point = heads[i] + (heads[i + 1] - heads[i]) * (part - i)
        # Near a joint the ring stands half way between the two bones.
        nearest = int(np.clip(round(part), 0, 3))
        turn = np.clip(0.5 + (part - nearest) / 0.5, 0.0, 1.0)
        axis = axes[max(nearest - 1, 0)] * (1 - turn) + axes[min(nearest, 2)] * turn
        rings.append((point, axis / np.linalg.norm(axis)))
    return rings


def _grow(b: _Builder, loop: list[int], outline: np.ndarray, name: str, finger: int, count: int, shape: tuple[int, int]):
    """A finger from `loop`; `outline` (len(loop), 2): place around, in half-widths of side and up; the cap is a grid of
    shape (columns, sides) faces."""
    up = -np.array(joint(f"{name}_1").bend)
    near = loop
    size = 0.0095 if finger == 0 else 0.0078
    rings = _finger_rings(name, count)
    for i, (point, axis) in enumerate(rings):
        frame = frame_along(axis, up)
        hold = min(1.0, 0.15 + 3.0 * (i + 1) / len(rings))
        far = []
        for side, height in outline:
            place = point + (frame[1] * side + frame[2] * height) * size
            far.append(b.vertex(place, finger, max(finger, 1), point, axis, hold if i < len(rings) - 1 else 0.2))
        b.strip(near, far)
        near = far
    columns, sides = shape
    # The cap: its outer rows and columns are the last ring, the rest is new.
    rows = [near[: columns + 1]]
    axis = rings[-1][1]
    for j in range(1, sides):
        left, right = near[-j], near[columns + j]
        row = [left]
        for i in range(1, columns):
            t = i / columns
            place = b.points[left] * (1 - t) + b.points[right] * t + axis * 0.002
            row.append(b.vertex(place, finger, max(finger, 1), place, axis, 0.0))
        rows.append(row + [right])
    bottom = near[columns + sides : 2 * columns + sides + 1]
    rows.append(bottom[::-1])
    b.patch(rows)


def _box_outline(columns: int, sides: int) -> np.ndarray:
    """(2 columns + 2 sides, 2) places around a finger in the order of the tube: back, ulnar, palm, radial."""
    corner = np.pi / 4
    angles = np.concatenate(
        [
            np.linspace(np.pi - corner, corner, columns + 1)[:-1],
            np.linspace(corner, -corner, sides + 1)[:-1],
            np.linspace(-corner, -np.pi + corner, columns + 1)[:-1],
            np.linspace(-np.pi + corner, -np.pi - corner, sides + 1)[:-1],
        ]
    )
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def build_grid(density: int) -> Grid:
    """The unsculpted quads; ValueError for a density other than 1, 2 or 3."""
    if density not in DIVISIONS:
        raise ValueError(f"The arm has densities 1, 2 and 3; {density!r} is none of them.")
    d = DIVISIONS[density]
    b, tube = _Builder(), _Tube(d)
    places = _ring_places(d)
    rings = _build_tube(b, tube, places)

    root = int(np.argmin(np.abs(places - 0.5925)))
    for r, (near, far) in enumerate(zip(rings, rings[1:])):
        for i in range(tube.around):
            k = (i + 1) % tube.around
            if i >= tube.palm(0) and root <= r < root + d.thumb_root:
                continue
            b.faces.append((near[i], far[i], far[k], near[k]))

    # Shoulder end: the back's columns sewn to the palm's.
    first = rings[0]
    rows = [first[: tube.top + 1]]
    for j in range(1, d.side):
        left, right = first[tube.around - j], first[tube.top + j]
        row = [left]
        for i in range(1, tube.top):
            t = i / tube.top
            place = b.points[left] * (1 - t) + b.points[right] * t
            row.append(b.vertex(place, -1, tube.column_finger[i], place, (1, 0, 0), 0.0))
        rows.append(row + [right])
    rows.append([first[tube.palm(i)] for i in range(tube.top + 1)])
    b.patch([row[::-1] for row in rows])

    _close_hand(b, tube, rings[-1], d)
    _grow_thumb(b, tube, rings, root, d)
    return b.grid()


def _close_hand(b: _Builder, tube: _Tube, last: list[int], d: Divisions):
    """Webs between the fingers, and the fingers."""
    # Down the side of a finger, from the back to the palm; the outer sides are the tube's own.
    walls: dict[tuple[int, str], list[int]] = {}
    walls[1, "radial"] = [last[0]] + [last[tube.around - j] for j in range(1, d.side)] + [last[tube.palm(0)]]
    walls[4, "ulnar"] = [last[tube.top + j] for j in range(d.side + 1)]
    for k in range(1, 4):
        a, c = tube.finger_start(k) + d.finger, tube.finger_start(k + 1)
        lines = []
        for i in range(a, c + 1):
            top, bottom = last[i], last[tube.palm(i)]
            line = [top]
            for j in range(1, d.side):
                t = j / d.side
                place = b.points[top] * (1 - t) + b.points[bottom] * t
                line.append(b.vertex(place, -1, tube.column_finger[i], place, (1, 0, 0), 0.15))
            lines.append(line + [bottom])
        b.patch(lines[::-1])
        walls[k, "ulnar"], walls[k + 1, "radial"] = lines[0], lines[-1]
    outline = _box_outline(d.finger, d.side)
    for k, name in enumerate(FINGERS, start=1):
        start = tube.finger_start(k)
        back = last[start : start + d.finger + 1]
        palm = [last[tube.palm(i)] for i in range(start, start + d.finger + 1)]
        loop = back + walls[k, "ulnar"][1:] + palm[::-1][1:] + walls[k, "radial"][::-1][1:-1]
        _grow(b, loop, outline, name, k, d.finger_rings, (d.finger, d.side))


def _grow_thumb(b: _Builder, tube: _Tube, rings: list[list[int]], root: int, d: Divisions):
    """The thumb out of the radial side between two rings of the palm."""
    n = d.thumb_root

    def side(r: int, j: int) -> int:
        """Vertex j = 0 (back) .. side (palm) of the radial side at ring root + r."""
        return rings[root + r][0 if j == 0 else tube.around - j]

    # Seen along the thumb its nail is turned to the back and the wrist: the wrist's edge of the root becomes the nail's
    # columns, the back's edge the side towards the index.
    back = [side(r, 0) for r in range(n + 1)]
    front = [side(n, j) for j in range(d.side + 1)]
    palm = [side(r, d.side) for r in range(n + 1)][::-1]
    wrist = [side(0, j) for j in range(d.side + 1)][::-1]
    loop = back + front[1:] + palm[1:] + wrist[1:-1]
    outline = _box_outline(n, d.side)
    _grow(b, loop, outline, "thumb", 0, d.thumb_rings, (n, d.side))
