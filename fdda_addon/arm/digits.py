# SPDX-License-Identifier: GPL-3.0-or-later
"""Quads of the webs, the fingers and the thumb, extruded from the tube."""

import numpy as np

from .field import axes_along, cubic_curve
from .joints import FINGERS, joint
from .quads import DIVISIONS, Grid, GridBuilder, SheetPosition
from .tube import Tube

# Rings of density 1 as parts along the three free bones (1.0 is the second bone's head), close at the joints; the first
# is the end of the tube, or the thumb's root.
_FINGER_RINGS = (0.33, 0.52, 0.71, 0.89, 1.12, 1.37, 1.64, 1.88, 2.13, 2.36, 2.60, 2.84, 3.04)
_THUMB_RINGS = (0.60, 0.72, 0.83, 0.94, 1.12, 1.35, 1.60, 1.86, 2.12, 2.38, 2.66, 2.94)
# How far from the axis the rings start, meters: outside the skin.
_FINGER_RADIUS, _THUMB_RADIUS = 0.0085, 0.0125
# The thumb leaves the hand askew. Corners of its root, by (wrist, webs) and (back, palm): outside the skin, in the
# folds where it parts from the hand. This part of its rings runs straight from there to its first joint.
_THUMB_CORNERS = np.array(
    [[(0.584, -0.036, 0.004), (0.586, -0.038, -0.034)], [(0.622, -0.046, -0.008), (0.622, -0.030, -0.022)]]
)
_THUMB_LOOP_OFFSET = 0.3


def grow_fingers(quads: GridBuilder, tube: Tube, last: list[int]):
    """Add the webs between the fingers at the tube's last ring, and the four fingers."""
    d = tube.divisions
    # Down the sides of each finger, from the back to the palm; the outer sides are the tube's own.
    radial = {1: [last[tube.side(j)] for j in range(d.side)] + [last[tube.palm(0)]]}
    ulnar = {4: [last[tube.top + j] for j in range(d.side + 1)]}
    for k in range(1, 4):
        lines = _lay_web(quads, tube, last, k)
        ulnar[k], radial[k + 1] = lines[0], lines[-1]
    for k, name in enumerate(FINGERS, start=1):
        columns = range(tube.finger_start(k), tube.finger_start(k) + d.finger + 1)
        back = [last[column] for column in columns]
        palm = [last[tube.palm(column)] for column in columns]
        loop = back + ulnar[k][1:] + palm[::-1][1:] + radial[k][::-1][1:-1]
        _grow(quads, name, loop, (d.finger, d.side), (DIVISIONS[1].finger, DIVISIONS[1].side), d.finger_rings)


def _lay_web(quads: GridBuilder, tube: Tube, last: list[int], k: int) -> list[list[int]]:
    """Add the web between fingers k and k + 1, as lines from the back to the palm."""
    d, g = tube.divisions, DIVISIONS[1]
    start = tube.finger_start(k) + d.finger
    lines = []
    for i in range(d.web + 1):
        top, bottom = last[start + i], last[tube.palm(start + i)]
        line = [top]
        for j in range(1, d.side):
            t = j / d.side
            point = quads.points[top] * (1 - t) + quads.points[bottom] * t
            sheet_position = SheetPosition(f"web_{k}", i * g.web / d.web, j * g.side / d.side)
            line.append(quads.vertex(point, sheet_position, -1, tube.finger_of(start + i)))
        lines.append([*line, bottom])
    quads.sheets[f"web_{k}"] = lines
    quads.patch(lines[::-1])
    return lines


def grow_thumb(quads: GridBuilder, tube: Tube, rings: list[list[int]]):
    """Add the thumb at the opening in the tube's side."""
    d, n = tube.divisions, tube.divisions.thumb_root

    def at(r: int, j: int) -> int:
        return rings[tube.root + r][tube.side(j)]

    # The nail looks to the front and the wrist: the root's edge at the wrist runs on into the nail's columns, the edge
    # at the back into the side above, and so on round.
    wrist = [at(0, j) for j in range(d.side + 1)][::-1]
    back = [at(r, 0) for r in range(n + 1)]
    webs = [at(n, j) for j in range(d.side + 1)]
    palm = [at(r, d.side) for r in range(n + 1)][::-1]
    for r in range(n + 1):
        edge = _THUMB_CORNERS[0] * (1 - r / n) + _THUMB_CORNERS[1] * (r / n)
        for j in range(d.side + 1):
            quads.points[at(r, j)] = edge[0] * (1 - j / d.side) + edge[1] * (j / d.side)
            quads.loose[at(r, j)] = False
    loop = wrist + back[1:] + webs[1:] + palm[1:-1]
    _grow(quads, "thumb", loop, (d.side, n), (DIVISIONS[1].side, DIVISIONS[1].thumb_root), d.thumb_rings)


def _finger_rings(name: str, number: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Compute axis point and unit axis of rings, indexed as in density 1."""
    thumb = name == "thumb"
    bones = [joint(f"{name}_{i}") for i in ((0, 1, 2) if thumb else (1, 2, 3))]
    heads = np.array([*(bone.head for bone in bones), bones[-1].tail])
    axes = np.diff(heads, axis=0)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    parts = np.array(_THUMB_RINGS if thumb else _FINGER_RINGS)
    rings = []
    for part in cubic_curve(number, np.arange(len(parts), dtype=float), parts[:, None])[:, 0]:
        i = min(int(part), 2)
        # Near a joint the ring turns from one bone to the next, half way at the joint itself.
        nearest = int(np.clip(round(part), 0, 3))
        turn = np.clip(0.5 + (part - nearest) / 0.5, 0.0, 1.0)
        axis = axes[max(nearest - 1, 0)] * (1 - turn) + axes[min(nearest, 2)] * turn
        rings.append((heads[i] + (heads[i + 1] - heads[i]) * (part - i), axis / np.linalg.norm(axis)))
    return rings


def _box_outline(columns: int, sides: int) -> np.ndarray:
    """(2 columns + 2 sides, 2) places side, up on a circle of radius 1, in the order back, ulnar, palm, radial."""
    corners = np.pi / 4 * np.array([3, 1, -1, -3, -5])
    counts = (columns, sides, columns, sides)
    pieces = [np.linspace(corners[i], corners[i + 1], count + 1)[:-1] for i, count in enumerate(counts)]
    angle = np.concatenate(pieces)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _grow(quads: GridBuilder, name: str, loop: list[int], shape: tuple[int, int], guide: tuple[int, int], count: int):
    """Make a digit of `count` rings out of `loop`, which runs around it like a box outline of `shape`: columns, sides.

    guide: that shape at density 1. The tip is closed with a patch of that shape.
    """
    digit = 0 if name == "thumb" else FINGERS.index(name) + 1
    guide_rings = len(_THUMB_RINGS if digit == 0 else _FINGER_RINGS) - 1
    number = np.arange(1, count + 1) * guide_rings / count
    rings = _finger_rings(name, number)
    outline = _box_outline(*shape)
    ends = np.cumsum([0, *shape, *shape])
    around = np.interp(np.arange(len(loop)), ends, np.cumsum([0, *guide, *guide]))
    up = -np.array(joint(f"{name}_1").bend)

    def ring_points(i: int, radius: float) -> np.ndarray:
        point, axis = rings[i]
        return point + outline @ axes_along(axis, up)[1:] * radius

    radius = _THUMB_RADIUS if digit == 0 else _FINGER_RADIUS
    askew = round(_THUMB_LOOP_OFFSET * count) if digit == 0 else 0
    root, straight = np.array([quads.points[i] for i in loop]), ring_points(askew, radius)
    sheet = [loop]
    for i, (middle, axis) in enumerate(rings):
        # Towards the tip the rings start narrower; the closing patch rounds it.
        points = ring_points(i, radius * (1.0 - 0.4 * max(0.0, number[i] - guide_rings + 1)))
        if i < askew:
            points = root + (straight - root) * ((i + 1) / (askew + 1))
        hold = float(np.clip(5.0 * (i - askew - 0.5) / count, 0.0, 1.0)) * (0.6 if i == count - 1 else 1.0)
        ring = []
        for j, point in enumerate(points):
            sheet_position = SheetPosition(name, float(number[i]), float(around[j]))
            ring.append(quads.vertex(point, sheet_position, digit, max(digit, 1), (middle, axis, hold)))
        quads.band(sheet[-1], ring)
        sheet.append(ring)
    quads.sheets[name] = sheet
    _close_tip(quads, name, digit, sheet[-1], shape, guide, rings[-1][1])


def _close_tip(quads: GridBuilder, name, digit, last, shape, guide, axis):
    columns, sides = shape
    rows = [last[: columns + 1]]
    for j in range(1, sides):
        left, right = last[-j], last[columns + j]
        row = [left]
        for i in range(1, columns):
            t = i / columns
            point = quads.points[left] * (1 - t) + quads.points[right] * t + axis * 0.004
            sheet_position = SheetPosition(f"{name}_tip", j * guide[1] / sides, i * guide[0] / columns)
            row.append(quads.vertex(point, sheet_position, digit, max(digit, 1)))
        rows.append([*row, right])
    rows.append(last[columns + sides : 2 * columns + sides + 1][::-1])
    quads.sheets[f"{name}_tip"] = rows
    quads.patch(rows)


def nail_faces(grid: Grid) -> np.ndarray:
    """Return which faces are nails, (f,) bool: the back of each digit over its last two rings of density 1."""
    on_nail = np.zeros(len(grid.sheet_positions), bool)
    for i, sheet_position in enumerate(grid.sheet_positions):
        if sheet_position.sheet in ("thumb", *FINGERS):
            rings = len(_THUMB_RINGS if sheet_position.sheet == "thumb" else _FINGER_RINGS) - 1
            columns = DIVISIONS[1].side if sheet_position.sheet == "thumb" else DIVISIONS[1].finger
            on_nail[i] = sheet_position.row > rings - 2.01 and sheet_position.column < columns + 0.01
    return on_nail[grid.faces].all(axis=1)
