# SPDX-License-Identifier: GPL-3.0-or-later
"""Gives a human with a Mixamo-style rig the range of motion of a person: `human_limits.py IN.blend OUT.blend`.

Written as Limit Rotation constraints in local space. A person's ranges are about directions of the body, bones have
axes of their own: every direction is given to the bone's axis that lies nearest to it, with the sign that fits.
"""

import math
import sys
from pathlib import Path

import bpy
from mathutils import Vector

PREFIX = "mixamorig:"
X, Y, Z = Vector((1, 0, 0)), Vector((0, 1, 0)), Vector((0, 0, 1))
"""Directions of a character that stands along Z and looks along -Y; X points to its left."""

# Bone: ranges in degrees about two directions of the body and about the bone itself (twist). Arms in a T pose, the
# left side; the right one is its mirror image.
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


def ranges_of(name: str) -> tuple | None:
    """The ranges of a bone, mirrored for the right side; None for one that is not in the list."""
    side = next((side for side in ("Left", "Right") if name.startswith(side)), "")
    part = name.removeprefix(side)
    part = part if part in RANGES else part.removeprefix("Hand")
    key = part if part in RANGES else part[-1:]
    found = RANGES.get(key)
    if found is None or side != "Right":
        return found
    first, second, (low, high) = found
    # Mirrored at the plane of Y and Z: rotations about X stay, the others turn round.
    about = [(axis, *((low, high) if axis is X else (-high, -low))) for axis, low, high in (first, second)]
    return (*about, (-high, -low))


def local_ranges(bone: bpy.types.Bone, ranges: tuple) -> list[tuple[float, float]]:
    """Ranges about the bone's own axes x, y and z, degrees."""
    axes = bone.matrix_local.to_3x3().transposed()
    (first, *bounds), (_, *others), twist = ranges
    dots = {place: Vector(axes[place]).dot(first) for place in (0, 2)}
    place = max(dots, key=lambda candidate: abs(dots[candidate]))
    found = [None, twist, None]
    found[place] = bounds if dots[place] > 0 else [-bounds[1], -bounds[0]]
    other = 2 - place
    sign = Vector(axes[other]).dot(ranges[1][0])
    found[other] = others if sign > 0 else [-others[1], -others[0]]
    return found


def main(source: Path, target: Path) -> None:
    """Set the limits of every bone of the only armature, and save."""
    bpy.ops.wm.open_mainfile(filepath=str(source.absolute()))
    (armature_object,) = (o for o in bpy.data.objects if o.type == "ARMATURE")
    for bone in armature_object.pose.bones:
        ranges = ranges_of(bone.name.removeprefix(PREFIX))
        if ranges is None:
            sys.exit(f"The bone '{bone.name}' has no range here; add it to the list.")
        limit = bone.constraints.new("LIMIT_ROTATION")
        limit.owner_space = "LOCAL"
        for axis, (low, high) in zip("xyz", local_ranges(bone.bone, ranges), strict=True):
            setattr(limit, f"use_limit_{axis}", True)
            setattr(limit, f"min_{axis}", math.radians(low))
            setattr(limit, f"max_{axis}", math.radians(high))
    bpy.ops.wm.save_as_mainfile(filepath=str(target.absolute()), copy=True)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:3]))
