# SPDX-License-Identifier: GPL-3.0-or-later
"""The range of motion where Blender's users keep it: read from a bone, and written to it.

The range is that of Limit Rotation and Limit Location constraints in local space, else of the bone's IK limits, else
the default; locked axes do not move. A Limit constraint whose influence is 0 states a range and holds nothing.
"""

from dataclasses import dataclass

import bpy

from ..core.errors import RigError
from ..core.poses import DEFAULT_RANGE

AXES = "xyz"
RANGE_NAME = "FDDA Range"
"""Name of the constraints that state a range and hold nothing."""
CONSTRAINT, IK, DEFAULT = "CONSTRAINT", "IK", "DEFAULT"


@dataclass(frozen=True)
class RotationRange:
    """Range of one rotation axis of a bone.

    Attributes:
        low, high: radians.
        source: `CONSTRAINT`, `IK` or `DEFAULT`: where it is stated.
        is_locked: the axis is locked and does not move at all.
    """

    low: float
    high: float
    source: str
    is_locked: bool

    @property
    def moves(self) -> bool:
        return not self.is_locked and self.low < self.high


def rotation_ranges(bone: bpy.types.PoseBone) -> tuple[RotationRange, RotationRange, RotationRange]:
    """Range of each rotation axis."""
    constraint = find_local_limit(bone, "LIMIT_ROTATION")
    return tuple(_rotation_range(bone, constraint, axis) for axis in range(3))


def _rotation_range(bone: bpy.types.PoseBone, constraint: bpy.types.Constraint | None, axis: int) -> RotationRange:
    letter, locked = AXES[axis], bone.lock_rotation[axis]
    if constraint is not None:
        if getattr(constraint, f"use_limit_{letter}"):
            low, high = getattr(constraint, f"min_{letter}"), getattr(constraint, f"max_{letter}")
            return RotationRange(low, high, CONSTRAINT, locked)
    elif getattr(bone, f"lock_ik_{letter}"):
        return RotationRange(0.0, 0.0, DEFAULT, True)
    elif getattr(bone, f"use_ik_limit_{letter}"):
        return RotationRange(getattr(bone, f"ik_min_{letter}"), getattr(bone, f"ik_max_{letter}"), IK, locked)
    return RotationRange(*DEFAULT_RANGE, DEFAULT, locked)


def location_ranges(bone: bpy.types.PoseBone) -> dict[int, tuple[float, float]]:
    """Range by axis, metres, of the axes that a Limit Location constraint limits on both ends."""
    return _limited(find_local_limit(bone, "LIMIT_LOCATION"))


def scale_ranges(bone: bpy.types.PoseBone) -> dict[int, tuple[float, float]]:
    """Range by axis, factors, of the axes that a Limit Scale constraint limits on both ends."""
    return _limited(find_local_limit(bone, "LIMIT_SCALE"))


def _limited(constraint: bpy.types.Constraint | None) -> dict[int, tuple[float, float]]:
    if constraint is None:
        return {}
    return {
        axis: (getattr(constraint, f"min_{letter}"), getattr(constraint, f"max_{letter}"))
        for axis, letter in enumerate(AXES)
        if getattr(constraint, f"use_min_{letter}") and getattr(constraint, f"use_max_{letter}")
    }


def find_local_limit(bone: bpy.types.PoseBone, kind: str) -> bpy.types.Constraint | None:
    """The constraint of this type that states a range, None when there is none."""
    for constraint in bone.constraints:
        if constraint.type == kind and constraint.owner_space == "LOCAL" and not constraint.mute:
            return constraint
    return None


def set_rotation_range(bone: bpy.types.PoseBone, axis: int, low: float, high: float) -> None:
    """Write the range of a rotation axis to a bone and unlock the axis.

    It is written where the bone states its range. A bone that states none gets IK limits, which leave posing by hand
    free, or a Limit Rotation constraint where the range does not hold the rest pose, which IK limits cannot say.

    Args:
        bone: the pose bone.
        axis: 0, 1 or 2.
        low, high: radians.

    Raises:
        RigError: the range is empty, or the bone's IK limits cannot say it.
    """
    if not low < high:
        raise RigError(f"The range of '{bone.name}' about {AXES[axis].upper()} is empty; give a larger maximum.")
    letter, constraint = AXES[axis], find_local_limit(bone, "LIMIT_ROTATION")
    states_ik = any(r.source == IK for r in rotation_ranges(bone))
    if constraint is None and low <= 0 <= high:
        setattr(bone, f"lock_ik_{letter}", False)
        setattr(bone, f"use_ik_limit_{letter}", True)
        setattr(bone, f"ik_min_{letter}", low)
        setattr(bone, f"ik_max_{letter}", high)
    elif constraint is None and states_ik:
        raise RigError(
            f"'{bone.name}' states its range as IK limits, which hold the rest pose; begin at 0 or below and end at 0 "
            "or above, or give the bone a Limit Rotation constraint in local space."
        )
    else:
        if constraint is None:
            constraint = bone.constraints.new("LIMIT_ROTATION")
            constraint.owner_space = "LOCAL"
        setattr(constraint, f"use_limit_{letter}", True)
        setattr(constraint, f"min_{letter}", low)
        setattr(constraint, f"max_{letter}", high)
    bone.lock_rotation[axis] = False


def clear_rotation_range(bone: bpy.types.PoseBone, axis: int) -> None:
    """Let a rotation axis have the default range again."""
    letter, constraint = AXES[axis], find_local_limit(bone, "LIMIT_ROTATION")
    if constraint is not None:
        setattr(constraint, f"use_limit_{letter}", False)
    else:
        setattr(bone, f"use_ik_limit_{letter}", False)
        setattr(bone, f"lock_ik_{letter}", False)


def ensure_range_constraint(bone: bpy.types.PoseBone, kind: str) -> bpy.types.Constraint:
    """The constraint that states the ranges of a bone without holding it: one of influence 0, made where there is none.

    It goes before what the bone states its ranges with, and takes them over.

    Args:
        bone: the pose bone.
        kind: "LIMIT_ROTATION", "LIMIT_LOCATION" or "LIMIT_SCALE".
    """
    stated = find_local_limit(bone, kind)
    if stated is not None and stated.influence == 0:
        return stated
    rotations = rotation_ranges(bone)
    others = {"LIMIT_LOCATION": location_ranges, "LIMIT_SCALE": scale_ranges}.get(kind, lambda _bone: {})(bone)
    constraint = bone.constraints.new(kind)
    constraint.name, constraint.owner_space, constraint.influence = RANGE_NAME, "LOCAL", 0.0
    bone.constraints.move(len(bone.constraints) - 1, 0)
    if kind == "LIMIT_ROTATION":
        for axis, r in enumerate(rotations):
            if r.source != DEFAULT:
                set_constraint_limit(constraint, axis, r.low, r.high)
            elif r.is_locked and not bone.lock_rotation[axis]:
                # An IK lock is not read beside a constraint.
                set_constraint_limit(constraint, axis, 0.0, 0.0)
    for axis, bounds in others.items():
        set_constraint_limit(constraint, axis, *bounds)
    return constraint


def set_constraint_limit(constraint: bpy.types.Constraint, axis: int, low: float, high: float) -> None:
    """Limit one axis in a Limit Rotation, Limit Location or Limit Scale constraint; radians, metres or factors."""
    letter = AXES[axis]
    for name in (f"use_limit_{letter}", f"use_min_{letter}", f"use_max_{letter}"):
        if hasattr(constraint, name):
            setattr(constraint, name, True)
    setattr(constraint, f"min_{letter}", low)
    setattr(constraint, f"max_{letter}", high)


def enforced_range(bone: bpy.types.PoseBone, kind: str, axis: int) -> tuple[float, float]:
    """What the Limit constraints in local space that hold a bone leave of an axis; infinite where none does."""
    low, high, letter = -float("inf"), float("inf"), AXES[axis]
    for constraint in bone.constraints:
        if constraint.type != kind or constraint.owner_space != "LOCAL" or constraint.mute or not constraint.influence:
            continue
        use = f"use_limit_{letter}"
        if getattr(constraint, use if hasattr(constraint, use) else f"use_min_{letter}"):
            low = max(low, getattr(constraint, f"min_{letter}"))
        if getattr(constraint, use if hasattr(constraint, use) else f"use_max_{letter}"):
            high = min(high, getattr(constraint, f"max_{letter}"))
    return low, high
