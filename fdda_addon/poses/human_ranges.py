# SPDX-License-Identifier: GPL-3.0-or-later
"""The range of motion of a person, for bones that are named as parts of a body.

A person's ranges are about directions of the body, and bones have axes of their own: each direction goes to the axis of
the bone that lies nearest to it, with the sign that fits. Arms are taken to be in a T pose, or not far from it.
"""

import math
import re

import bpy
from mathutils import Matrix, Vector

X, Y, Z = Vector((1, 0, 0)), Vector((0, 1, 0)), Vector((0, 0, 1))
"""Directions of a character that stands along Z and looks along -Y; X points to its left."""

Side = tuple[Vector, float, float]
Ranges = tuple[Side, Side, tuple[float, float]]
"""Degrees about two directions of the body and about the bone itself, of the left side."""

_SPINE: Ranges = ((X, -10, 20), (Y, -12, 12), (-12, 12))
RANGES: tuple[tuple[str, Ranges], ...] = (
    (r"hips?|pelvis|torso", ((X, -20, 20), (Y, -15, 15), (-20, 20))),
    (r"spine\d*|chest|upperchest|abdomen|waist", _SPINE),
    (r"neck\d*", ((X, -20, 20), (Y, -15, 15), (-25, 25))),
    (r"head", ((X, -20, 25), (Y, -15, 15), (-30, 30))),
    (r"upleg|thigh\d*|upperleg|hipjoint", ((X, -80, 20), (Y, -35, 10), (-20, 20))),
    (r"leg|shin\d*|calf|lowerleg|knee", ((X, 0, 110), (Y, 0, 0), (-5, 5))),
    (r"foot|ankle", ((X, -20, 35), (Z, -15, 15), (-10, 10))),
    (r"toebase|toes?|ball", ((X, -30, 15), (Z, 0, 0), (0, 0))),
    (r"shoulder|clavicle|collar", ((Y, -15, 10), (Z, -10, 10), (-5, 5))),
    (r"arm|upperarm\d*", ((Y, -50, 70), (Z, -70, 20), (-35, 35))),
    (r"forearm\d*|lowerarm|elbow", ((Z, -120, 0), (Y, 0, 0), (-45, 45))),
    (r"hand|wrist", ((Y, -50, 50), (Z, -20, 20), (-10, 10))),
    (r"(hand)?thumb0?1", ((Y, -15, 15), (Z, -20, 20), (-15, 15))),
    (r"(hand)?thumb0?2", ((Y, 0, 0), (Z, -30, 15), (0, 0))),
    (r"(hand)?thumb0?3", ((Y, 0, 0), (Z, -45, 10), (0, 0))),
    (r"(hand|f)?(index|middle|ring|pinky|little)(finger)?0?1", ((Y, -15, 75), (Z, -8, 8), (0, 0))),
    (r"(hand|f)?(index|middle|ring|pinky|little)(finger)?0?2", ((Y, 0, 90), (Z, 0, 0), (0, 0))),
    (r"(hand|f)?(index|middle|ring|pinky|little)(finger)?0?3", ((Y, 0, 60), (Z, 0, 0), (0, 0))),
)
_SIDE = re.compile(r"(?P<before>^|[^a-z])(?P<side>left|right|l|r)(?=$|[^a-z])|^(?P<word>left|right)", re.IGNORECASE)
_LETTERS = {"l": "left", "r": "right"}


def body_part_of(name: str) -> tuple[Ranges | None, str]:
    """Ranges of a bone by its name, as of the left side, and "left", "right" or ""; None for what is no such part."""
    own = name.rpartition(":")[2]
    own = re.sub(r"(?i)^(def|org|mch|cc_base|bip0+1|b)[-_ ]+", "", own)
    side = ""
    if match := _SIDE.search(own):
        side = match["side"] or match["word"]
        own = own[: match.start()] + own[match.end() :]
        side = _LETTERS.get(side.lower(), side.lower())
    plain = re.sub(r"[^a-z0-9]", "", own.lower())
    ranges = next((ranges for pattern, ranges in RANGES if re.fullmatch(pattern, plain)), None)
    return ranges, side


def human_ranges(armature_object: bpy.types.Object, bone: bpy.types.Bone) -> list[tuple[float, float]] | None:
    """Ranges of a bone about its own axes x, y and z, radians; None where its name is of no part of a body."""
    ranges, side = body_part_of(bone.name)
    if ranges is None:
        return None
    if side == "right":
        first, second, (low, high) = ranges
        # Mirrored at the plane of Y and Z: rotations about X stay, the others turn round.
        about = [(axis, *((low_, high_) if axis is X else (-high_, -low_))) for axis, low_, high_ in (first, second)]
        ranges = (*about, (-high, -low))
    matrix: Matrix = armature_object.matrix_world.to_quaternion().to_matrix() @ bone.matrix_local.to_3x3()
    return [(math.radians(low), math.radians(high)) for low, high in _about_own_axes(matrix, ranges)]


def _about_own_axes(matrix: Matrix, ranges: Ranges) -> list[tuple[float, float]]:
    axes = matrix.transposed()
    (first, *bounds), (second, *others), twist = ranges
    place = max((0, 2), key=lambda candidate: abs(axes[candidate].dot(first)))
    found = [twist, twist, twist]
    for axis, direction, (low, high) in ((place, first, bounds), (2 - place, second, others)):
        found[axis] = (low, high) if axes[axis].dot(direction) > 0 else (-high, -low)
    return found
