# SPDX-License-Identifier: GPL-3.0-or-later
"""Provides human ranges of motion for bones that are named after body parts.

Human ranges refer to directions of the body, but the axes of bones differ. So each direction is assigned to the nearest
axis of the bone, with the matching sign. Arms are assumed to be in a T-pose, or close to it.
"""

import math
import re

import bpy
from mathutils import Matrix, Vector

X, Y, Z = Vector((1, 0, 0)), Vector((0, 1, 0)), Vector((0, 0, 1))
"""Axes of a character that stands along Z and faces -Y; X points to its left."""

AxisRange = tuple[Vector, float, float]
"""A direction of the body, and the range about it in degrees."""
BodyPartRanges = tuple[AxisRange, AxisRange, tuple[float, float]]
"""Ranges in degrees about two directions of the body, and about the bone itself, for the left side."""

_SPINE_RANGES: BodyPartRanges = ((X, -10, 20), (Y, -12, 12), (-12, 12))
RANGES_BY_NAME_PATTERN: tuple[tuple[str, BodyPartRanges], ...] = (
    (r"hips?|pelvis|torso", ((X, -20, 20), (Y, -15, 15), (-20, 20))),
    (r"spine\d*|chest|upperchest|abdomen|waist", _SPINE_RANGES),
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
_SIDE_IN_NAME = re.compile(
    r"(?P<before>^|[^a-z])(?P<side>left|right|l|r)(?=$|[^a-z])|^(?P<word>left|right)", re.IGNORECASE
)
_SIDES_BY_LETTER = {"l": "left", "r": "right"}


def body_part_of(name: str) -> tuple[BodyPartRanges | None, str]:
    """Find the body part of a bone by its name.

    Returns:
        The ranges of the body part for the left side, None if the name matches no body part; and "left", "right" or "".
    """
    part_name = name.rpartition(":")[2]
    part_name = re.sub(r"(?i)^(def|org|mch|cc_base|bip0+1|b)[-_ ]+", "", part_name)
    side = ""
    if match := _SIDE_IN_NAME.search(part_name):
        side = match["side"] or match["word"]
        part_name = part_name[: match.start()] + part_name[match.end() :]
        side = _SIDES_BY_LETTER.get(side.lower(), side.lower())
    normalized_name = re.sub(r"[^a-z0-9]", "", part_name.lower())
    ranges = next(
        (ranges for pattern, ranges in RANGES_BY_NAME_PATTERN if re.fullmatch(pattern, normalized_name)), None
    )
    return ranges, side


def human_ranges(armature_object: bpy.types.Object, bone: bpy.types.Bone) -> list[tuple[float, float]] | None:
    """Return the ranges of a bone about its axes x, y and z in radians; None if its name matches no body part."""
    ranges, side = body_part_of(bone.name)
    if ranges is None:
        return None
    if side == "right":
        first_range, second_range, (low, high) = ranges
        # In a reflection at the YZ plane, rotations about X keep their sign, and other rotations change it.
        mirrored_ranges = [
            (axis, *((axis_low, axis_high) if axis is X else (-axis_high, -axis_low)))
            for axis, axis_low, axis_high in (first_range, second_range)
        ]
        ranges = (*mirrored_ranges, (-high, -low))
    matrix: Matrix = armature_object.matrix_world.to_quaternion().to_matrix() @ bone.matrix_local.to_3x3()
    return [(math.radians(low), math.radians(high)) for low, high in _ranges_about_bone_axes(matrix, ranges)]


def _ranges_about_bone_axes(matrix: Matrix, ranges: BodyPartRanges) -> list[tuple[float, float]]:
    """Assign ranges about directions of the body to the axes of a bone, given its matrix in world space."""
    bone_axes = matrix.transposed()
    (first_direction, *first_range), (second_direction, *second_range), twist_range = ranges
    first_axis = max((0, 2), key=lambda axis: abs(bone_axes[axis].dot(first_direction)))
    bone_ranges = [twist_range, twist_range, twist_range]
    for axis, direction, (low, high) in (
        (first_axis, first_direction, first_range),
        (2 - first_axis, second_direction, second_range),
    ):
        bone_ranges[axis] = (low, high) if bone_axes[axis].dot(direction) > 0 else (-high, -low)
    return bone_ranges
