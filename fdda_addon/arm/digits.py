# SPDX-License-Identifier: GPL-3.0-or-later
"""Adds the quads of the webs, the fingers and the thumb to the tube."""

import numpy as np

from .field import axes_along, cubic_curve
from .joints import FINGERS, joint
from .quads import DIVISIONS, Grid, GridBuilder, SheetPosition
from .tube import Tube

# Positions of the rings of density 1 along the three free bones, in bone lengths: 1.0 is the head of the second bone.
# The rings are close together at the joints. The first ring is the end of the tube, or the root of the thumb.
_FINGER_RING_POSITIONS = (0.33, 0.52, 0.71, 0.89, 1.12, 1.37, 1.64, 1.88, 2.13, 2.36, 2.60, 2.84, 3.04)
_THUMB_RING_POSITIONS = (0.60, 0.72, 0.83, 0.94, 1.12, 1.35, 1.60, 1.86, 2.12, 2.38, 2.66, 2.94)
# Initial radius of the rings, meters; they start outside the skin.
_FINGER_RADIUS, _THUMB_RADIUS = 0.0085, 0.0125
# The thumb grows out of the hand at an angle. These are the corners of its root, by (wrist, webs) and (back, palm).
# They are outside the skin, in the folds between thumb and hand.
_THUMB_CORNERS = np.array(
    [[(0.584, -0.036, 0.004), (0.586, -0.038, -0.034)], [(0.622, -0.046, -0.008), (0.622, -0.030, -0.022)]]
)
# Fraction of the thumb's rings that are interpolated between this root and the ring at the end of the fraction.
_THUMB_ROOT_FRACTION = 0.3


def grow_fingers(quads: GridBuilder, tube: Tube, last_ring: list[int]):
    """Add the webs between the fingers, and the four fingers, to the last ring of the tube."""
    divisions = tube.divisions
    # Vertices of the sides of each finger, from the back to the palm. The outer sides of the hand belong to the tube.
    radial_sides = {1: [last_ring[tube.side(j)] for j in range(divisions.side)] + [last_ring[tube.palm(0)]]}
    ulnar_sides = {4: [last_ring[tube.top + j] for j in range(divisions.side + 1)]}
    for finger_number in range(1, 4):
        lines = _lay_web(quads, tube, last_ring, finger_number)
        ulnar_sides[finger_number], radial_sides[finger_number + 1] = lines[0], lines[-1]
    for finger_number, name in enumerate(FINGERS, start=1):
        columns = range(tube.finger_start(finger_number), tube.finger_start(finger_number) + divisions.finger + 1)
        back_vertices = [last_ring[column] for column in columns]
        palm_vertices = [last_ring[tube.palm(column)] for column in columns]
        loop = (
            back_vertices
            + ulnar_sides[finger_number][1:]
            + palm_vertices[::-1][1:]
            + radial_sides[finger_number][::-1][1:-1]
        )
        _grow_digit(
            quads,
            name,
            loop,
            (divisions.finger, divisions.side),
            (DIVISIONS[1].finger, DIVISIONS[1].side),
            divisions.finger_rings,
        )


def _lay_web(quads: GridBuilder, tube: Tube, last_ring: list[int], finger_number: int) -> list[list[int]]:
    """Add the web after a finger, and return its vertices as lines from the back to the palm."""
    divisions, guide_divisions = tube.divisions, DIVISIONS[1]
    first_column = tube.finger_start(finger_number) + divisions.finger
    lines = []
    for line_index in range(divisions.web + 1):
        top_vertex, bottom_vertex = (
            last_ring[first_column + line_index],
            last_ring[tube.palm(first_column + line_index)],
        )
        line = [top_vertex]
        for row in range(1, divisions.side):
            fraction = row / divisions.side
            point = quads.points[top_vertex] * (1 - fraction) + quads.points[bottom_vertex] * fraction
            sheet_position = SheetPosition(
                f"web_{finger_number}",
                line_index * guide_divisions.web / divisions.web,
                row * guide_divisions.side / divisions.side,
            )
            line.append(quads.add_vertex(point, sheet_position, -1, tube.finger_of(first_column + line_index)))
        lines.append([*line, bottom_vertex])
    quads.sheets[f"web_{finger_number}"] = lines
    quads.add_patch(lines[::-1])
    return lines


def grow_thumb(quads: GridBuilder, tube: Tube, rings: list[list[int]]):
    """Add the thumb at the opening in the side of the tube."""
    divisions, ring_count = tube.divisions, tube.divisions.thumb_root

    def root_vertex(ring: int, row: int) -> int:
        return rings[tube.root + ring][tube.side(row)]

    # The nail faces the front and the wrist: the edge of the root at the wrist continues in the columns of the nail,
    # the edge at the back continues in the side next to them, and so on around the thumb.
    wrist_edge = [root_vertex(0, row) for row in range(divisions.side + 1)][::-1]
    back_edge = [root_vertex(ring, 0) for ring in range(ring_count + 1)]
    web_edge = [root_vertex(ring_count, row) for row in range(divisions.side + 1)]
    palm_edge = [root_vertex(ring, divisions.side) for ring in range(ring_count + 1)][::-1]
    for ring in range(ring_count + 1):
        corners = _THUMB_CORNERS[0] * (1 - ring / ring_count) + _THUMB_CORNERS[1] * (ring / ring_count)
        for row in range(divisions.side + 1):
            quads.points[root_vertex(ring, row)] = corners[0] * (1 - row / divisions.side) + corners[1] * (
                row / divisions.side
            )
            quads.loose[root_vertex(ring, row)] = False
    loop = wrist_edge + back_edge[1:] + web_edge[1:] + palm_edge[1:-1]
    _grow_digit(
        quads,
        "thumb",
        loop,
        (divisions.side, ring_count),
        (DIVISIONS[1].side, DIVISIONS[1].thumb_root),
        divisions.thumb_rings,
    )


def _ring_axes(name: str, ring_indices: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Compute the center and the unit axis of rings, given by their (possibly fractional) indices in density 1."""
    is_thumb = name == "thumb"
    bones = [joint(f"{name}_{bone_index}") for bone_index in ((0, 1, 2) if is_thumb else (1, 2, 3))]
    heads = np.array([*(bone.head for bone in bones), bones[-1].tail])
    axes = np.diff(heads, axis=0)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    ring_positions = np.array(_THUMB_RING_POSITIONS if is_thumb else _FINGER_RING_POSITIONS)
    rings = []
    for position in cubic_curve(ring_indices, np.arange(len(ring_positions), dtype=float), ring_positions[:, None])[
        :, 0
    ]:
        bone_index = min(int(position), 2)
        # Near a joint, the axis is blended from one bone to the next; at the joint itself both have the same weight.
        nearest_joint = int(np.clip(round(position), 0, 3))
        weight = np.clip(0.5 + (position - nearest_joint) / 0.5, 0.0, 1.0)
        axis = axes[max(nearest_joint - 1, 0)] * (1 - weight) + axes[min(nearest_joint, 2)] * weight
        rings.append(
            (
                heads[bone_index] + (heads[bone_index + 1] - heads[bone_index]) * (position - bone_index),
                axis / np.linalg.norm(axis),
            )
        )
    return rings


def _box_outline(columns: int, sides: int) -> np.ndarray:
    """Return points on the unit circle for a ring with a rectangular outline.

    Returns:
        (2 columns + 2 sides, 2) side and up coordinates, in the order back, ulnar side, palm, radial side.
    """
    corner_angles = np.pi / 4 * np.array([3, 1, -1, -3, -5])
    counts = (columns, sides, columns, sides)
    side_angles = [
        np.linspace(corner_angles[i], corner_angles[i + 1], count + 1)[:-1] for i, count in enumerate(counts)
    ]
    angles = np.concatenate(side_angles)
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _grow_digit(
    quads: GridBuilder,
    name: str,
    loop: list[int],
    shape: tuple[int, int],
    guide_shape: tuple[int, int],
    ring_count: int,
):
    """Add a digit: rings of quads, and a patch that closes the tip."""
    digit = 0 if name == "thumb" else FINGERS.index(name) + 1
    guide_ring_count = len(_THUMB_RING_POSITIONS if digit == 0 else _FINGER_RING_POSITIONS) - 1
    ring_indices = np.arange(1, ring_count + 1) * guide_ring_count / ring_count
    rings = _ring_axes(name, ring_indices)
    outline = _box_outline(*shape)
    corner_indices = np.cumsum([0, *shape, *shape])
    guide_columns = np.interp(np.arange(len(loop)), corner_indices, np.cumsum([0, *guide_shape, *guide_shape]))
    up_axis = -np.array(joint(f"{name}_1").bend)

    def ring_points(i: int, radius: float) -> np.ndarray:
        point, axis = rings[i]
        return point + outline @ axes_along(axis, up_axis)[1:] * radius

    radius = _THUMB_RADIUS if digit == 0 else _FINGER_RADIUS
    root_ring_count = round(_THUMB_ROOT_FRACTION * ring_count) if digit == 0 else 0
    root_points, straight_points = np.array([quads.points[i] for i in loop]), ring_points(root_ring_count, radius)
    sheet = [loop]
    for i, (center, axis) in enumerate(rings):
        # Rings near the tip start narrower, and the patch that closes the tip makes it round.
        points = ring_points(i, radius * (1.0 - 0.4 * max(0.0, ring_indices[i] - guide_ring_count + 1)))
        if i < root_ring_count:
            points = root_points + (straight_points - root_points) * ((i + 1) / (root_ring_count + 1))
        plane_hold = float(np.clip(5.0 * (i - root_ring_count - 0.5) / ring_count, 0.0, 1.0)) * (
            0.6 if i == ring_count - 1 else 1.0
        )
        ring = []
        for j, point in enumerate(points):
            sheet_position = SheetPosition(name, float(ring_indices[i]), float(guide_columns[j]))
            ring.append(quads.add_vertex(point, sheet_position, digit, max(digit, 1), (center, axis, plane_hold)))
        quads.add_band(sheet[-1], ring)
        sheet.append(ring)
    quads.sheets[name] = sheet
    _close_tip(quads, name, digit, sheet[-1], shape, guide_shape, rings[-1][1])


def _close_tip(quads: GridBuilder, name, digit, last_ring, shape, guide_shape, axis):
    """Close the tip of a digit with a patch of quads."""
    columns, sides = shape
    rows = [last_ring[: columns + 1]]
    for j in range(1, sides):
        left_vertex, right_vertex = last_ring[-j], last_ring[columns + j]
        row = [left_vertex]
        for i in range(1, columns):
            fraction = i / columns
            point = quads.points[left_vertex] * (1 - fraction) + quads.points[right_vertex] * fraction + axis * 0.004
            sheet_position = SheetPosition(f"{name}_tip", j * guide_shape[1] / sides, i * guide_shape[0] / columns)
            row.append(quads.add_vertex(point, sheet_position, digit, max(digit, 1)))
        rows.append([*row, right_vertex])
    rows.append(last_ring[columns + sides : 2 * columns + sides + 1][::-1])
    quads.sheets[f"{name}_tip"] = rows
    quads.add_patch(rows)


def nail_faces(grid: Grid) -> np.ndarray:
    """Return which faces are nails, (f,) bool: faces on the back of each digit in its last two rings of density 1."""
    on_nail = np.zeros(len(grid.sheet_positions), bool)
    for vertex_index, sheet_position in enumerate(grid.sheet_positions):
        if sheet_position.sheet in ("thumb", *FINGERS):
            last_guide_ring = (
                len(_THUMB_RING_POSITIONS if sheet_position.sheet == "thumb" else _FINGER_RING_POSITIONS) - 1
            )
            guide_columns = DIVISIONS[1].side if sheet_position.sheet == "thumb" else DIVISIONS[1].finger
            on_nail[vertex_index] = (
                sheet_position.row > last_guide_ring - 2.01 and sheet_position.column < guide_columns + 0.01
            )
    return on_nail[grid.faces].all(axis=1)
