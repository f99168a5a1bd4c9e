# SPDX-License-Identifier: GPL-3.0-or-later
"""Limit a human with a Mixamo-style rig to the range of motion of a person: `human_limits.py IN.blend OUT.blend`.

Writes the limits as Limit Rotation constraints in local space. A person's ranges are defined about directions of the
body, and each bone has different axes. Each range applies to the bone's axis that is
nearest to its direction, and is mirrored if that axis points the opposite way.
"""

import math
import sys
from pathlib import Path

import bpy
from mathutils import Vector

PREFIX = "mixamorig:"
X, Y, Z = Vector((1, 0, 0)), Vector((0, 1, 0)), Vector((0, 0, 1))
"""Directions of the body: the character stands upright along Z and faces -Y, so that X points to its left."""

# By bone: ranges in degrees about two directions of the body and about the bone itself (twist). They are for the left
# side with the arms in a T-pose; the right side is mirrored.
RANGES = {
    "Hips": ((X, -20, 20), (Y, -15, 15), (-20, 20)),
    "Spine": ((X, -10, 20), (Y, -12, 12), (-12, 12)),
    "Spine1": ((X, -10, 20), (Y, -12, 12), (-12, 12)),
    "Spine2": ((X, -10, 20), (Y, -12, 12), (-12, 12)),
    "Neck": ((X, -20, 20), (Y, -15, 15), (-25, 25)),
    "Head": ((X, -20, 25), (Y, -15, 15), (-30, 30)),
    "UpLeg": ((X, -80, 20), (Y, -35, 10), (-20, 20)),
    "Leg": ((X, 0, 110), (Y, 0, 0), (-5, 5)),
    "Foot": ((X, -20, 35), (Z, -15, 15), (-10, 10)),
    "ToeBase": ((X, -30, 15), (Z, 0, 0), (0, 0)),
    "Shoulder": ((Y, -15, 10), (Z, -10, 10), (-5, 5)),
    "Arm": ((Y, -50, 70), (Z, -70, 20), (-35, 35)),
    "ForeArm": ((Z, -120, 0), (Y, 0, 0), (-45, 45)),
    "Hand": ((Y, -50, 50), (Z, -20, 20), (-10, 10)),
    "Thumb1": ((Y, -15, 15), (Z, -20, 20), (-15, 15)),
    "Thumb2": ((Y, 0, 0), (Z, -30, 15), (0, 0)),
    "Thumb3": ((Y, 0, 0), (Z, -45, 10), (0, 0)),
    "1": ((Y, -15, 75), (Z, -8, 8), (0, 0)),
    "2": ((Y, 0, 90), (Z, 0, 0), (0, 0)),
    "3": ((Y, 0, 60), (Z, 0, 0), (0, 0)),
}


def body_ranges(name: str) -> tuple | None:
    """Return the ranges of a bone, mirrored for the right side, or None if the bone is not in the list."""
    side = next((side for side in ("Left", "Right") if name.startswith(side)), "")
    base_name = name.removeprefix(side)
    base_name = base_name if base_name in RANGES else base_name.removeprefix("Hand")
    key = base_name if base_name in RANGES else base_name[-1:]
    ranges = RANGES.get(key)
    if ranges is None or side != "Right":
        return ranges
    first, second, (low, high) = ranges
    # Mirroring at the YZ plane keeps rotations about X and reverses the others.
    direction_ranges = [(axis, *((low, high) if axis is X else (-high, -low))) for axis, low, high in (first, second)]
    return (*direction_ranges, (-high, -low))


def local_ranges(bone: bpy.types.Bone, ranges: tuple) -> list[tuple[float, float]]:
    """Convert the ranges of a bone to rotations about the bone's x, y and z axes, degrees."""
    axes = bone.matrix_local.to_3x3().transposed()
    (first_direction, *first_range), (second_direction, *second_range), twist = ranges
    dots = {axis: Vector(axes[axis]).dot(first_direction) for axis in (0, 2)}
    first_axis = max(dots, key=lambda axis: abs(dots[axis]))
    second_axis = 2 - first_axis
    axis_ranges = [None, twist, None]
    axis_ranges[first_axis] = first_range if dots[first_axis] > 0 else [-first_range[1], -first_range[0]]
    second_dot = Vector(axes[second_axis]).dot(second_direction)
    axis_ranges[second_axis] = second_range if second_dot > 0 else [-second_range[1], -second_range[0]]
    return axis_ranges


def main(source_path: Path, output_path: Path) -> None:
    """Limit the rotation of every bone of the only armature, and save."""
    bpy.ops.wm.open_mainfile(filepath=str(source_path.absolute()))
    (armature_object,) = (o for o in bpy.data.objects if o.type == "ARMATURE")
    for bone in armature_object.pose.bones:
        ranges = body_ranges(bone.name.removeprefix(PREFIX))
        if ranges is None:
            sys.exit(f"The bone '{bone.name}' is not in RANGES of this file; add its ranges there.")
        limit = bone.constraints.new("LIMIT_ROTATION")
        limit.owner_space = "LOCAL"
        for axis, (low, high) in zip("xyz", local_ranges(bone.bone, ranges), strict=True):
            setattr(limit, f"use_limit_{axis}", True)
            setattr(limit, f"min_{axis}", math.radians(low))
            setattr(limit, f"max_{axis}", math.radians(high))
    bpy.ops.wm.save_as_mainfile(filepath=str(output_path.absolute()), copy=True)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
