# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether the joints of a rig lie in its mesh: mistakes of units and axes."""

import itertools

import numpy as np

from ..partition import main_joints
from ..rig import STATIC_JOINT, Rig
from .warning import RecordingWarning, length

SMALLEST, LARGEST = 0.005, 100.0
"""Sizes of a mesh in metres beyond which its unit is taken for something else."""
SCALE_RATIO = 5.0
"""Joints and the vertices that follow them differ in size by less than this."""
ALIKE = 0.8
"""Correlation of the places of joints and of their vertices from which on one is an image of the other."""
FAR = 0.1
"""A joint is far from its vertices beyond this part of the size of the character."""


def check_rest(rig: Rig) -> list[RecordingWarning]:
    """Warnings "units" and "axes"."""
    if not SMALLEST <= rig.size * rig.metres_per_unit <= LARGEST:
        text = (
            f"The mesh is {length(rig, rig.size)} large, so errors and tolerances in mm mean little: set the unit "
            "scale of the scene to the unit that the character is built in (0.01 for centimetres), or scale it to its "
            "true size, and record again."
        )
        return [RecordingWarning("units", text)]
    main = main_joints(rig.skin_joints, rig.skin_weights)
    joints = np.array([j for j in np.unique(main) if rig.joints[j].name != STATIC_JOINT], np.int64)
    if len(joints) < 2:
        # One joint may be anywhere: a door turns on its hinge.
        return []
    places = rig.rest_matrices[joints, :3, 3].astype(np.float64)
    own = [rig.rest_positions[main == joint].astype(np.float64) for joint in joints]
    middles = np.stack([vertices.mean(axis=0) for vertices in own])
    turn, likeness, upright = _best_turn(places, middles)
    spans = [float(np.linalg.norm(np.ptp(points, axis=0))) for points in (places, middles)]
    ratio = spans[1] / max(spans[0], 1e-9)
    if len(joints) > 2 and likeness > ALIKE and not 1 / SCALE_RATIO < ratio < SCALE_RATIO:
        of_joints, of_vertices = (length(rig, span) for span in spans)
        text = (
            f"The {len(joints)} joints that skin the mesh lie {of_joints} apart and their vertices "
            f"{of_vertices}, {_times(ratio)}: the scale of mesh or armature is not applied, or one was imported "
            "in another unit; give both one size in the rest pose and record again."
        )
        return [RecordingWarning("units", text)]
    apart = np.array([np.linalg.norm(v - p, axis=1).min() for v, p in zip(own, places, strict=True)])
    size = max(rig.size, float(np.linalg.norm(np.ptp(rig.rest_matrices[:, :3, 3], axis=0))))
    if np.median(apart) <= FAR * size:
        return []
    low, high = rig.rest_positions.min(axis=0), rig.rest_positions.max(axis=0)
    outside = int(((places < low) | (places > high)).any(axis=1).sum())
    seen = (
        f"their places fit after {turn}"
        if turn and len(joints) > 2 and likeness > max(ALIKE, upright + 0.2)
        else f"most of it along {_direction(np.median(middles - places, axis=0))}"
    )
    text = (
        f"{outside} of the {len(joints)} joints that skin the mesh lie outside its bounds, and joints lie "
        f"{length(rig, float(np.median(apart)))} from the nearest vertex that follows them (median), {seen}: mesh and "
        "armature do not match in the rest pose; bring them together, apply their transforms and record again."
    )
    return [RecordingWarning("axes", text)]


def _best_turn(places: np.ndarray, middles: np.ndarray) -> tuple[str, float, float]:
    """How joints have to be turned to lie like their vertices.

    Args:
        places, middles: (n, 3) joints and the middles of their vertices, metres.

    Returns:
        The best of the turns of a cube, in words, empty for none; the correlation with it and without any.
    """
    a, b = places - places.mean(axis=0), middles - middles.mean(axis=0)
    scale = max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-12)
    upright = float((a * b).sum()) / scale
    turns = [
        turn
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1, -1), repeat=3)
        if np.linalg.det(turn := np.eye(3)[list(order)] * np.array(signs)[:, None]) > 0
    ]
    likeness = [round(float(((a @ turn.T) * b).sum()) / scale, 2) for turn in turns]
    # Joints in a row fit after several turns: the one is meant that leaves most axes where they are.
    best = max(range(len(turns)), key=lambda i: (likeness[i], np.trace(turns[i])))
    return _turn_in_words(turns[best]), likeness[best], upright


def _turn_in_words(turn: np.ndarray) -> str:
    angle = round(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))
    kept = np.flatnonzero(np.diagonal(turn) == 1)
    if len(kept) == 3:
        return ""
    if len(kept) != 1:
        return "an exchange of the axes"
    x, y = (i for i in range(3) if i != kept[0])
    # Counter-clockwise about Y turns Z towards X.
    positive = turn[y, x] > 0 if kept[0] != 1 else turn[x, y] > 0
    sign = "" if angle == 180 or positive else "-"
    return f"a turn of {sign}{angle} degrees about {'XYZ'[kept[0]]}"


def _direction(offset: np.ndarray) -> str:
    axis = int(np.abs(offset).argmax())
    return f"{'-' if offset[axis] < 0 else '+'}{'XYZ'[axis]}"


def _times(ratio: float) -> str:
    return f"{ratio:.3g} times as far" if ratio > 1 else f"only 1/{1 / ratio:.3g} of it"
