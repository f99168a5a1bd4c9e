# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads and writes the range of motion of a bone, which is stored in constraints and IK limits.

The range is stored in Limit constraints in local space, or else in the bone's IK limits. Without these the bone
has the default range. Locked axes do not move. A Limit constraint with an influence of 0 stores a range without
enforcing it.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import bpy
import numpy as np

from ..core.controls import ARMATURE_OBJECT
from ..core.errors import RigError
from ..core.mathematics.poses import DEFAULT_RANGE, LOCATION, ROTATION, SCALE, Channel
from ..core.rig import Rig
from ..scene.armature import FOUR_COMPONENT_ROTATIONS

AXES = "xyz"
CONSTRAINT, IK, DEFAULT = "CONSTRAINT", "IK", "DEFAULT"
"""Where a range is stored: in a Limit constraint, as IK limits, or nowhere, so that the default range applies."""


@dataclass(frozen=True)
class RotationRange:
    """Range of one rotation axis of a bone.

    Attributes:
        low, high: radians.
        source: where the range is stored: `CONSTRAINT`, `IK` or `DEFAULT`.
        is_locked: the axis is locked.
    """

    low: float
    high: float
    source: str
    is_locked: bool

    @property
    def moves(self) -> bool:
        """Return whether the axis can move."""
        return not self.is_locked and self.low < self.high


def rotation_ranges(bone: bpy.types.PoseBone) -> tuple[RotationRange, RotationRange, RotationRange]:
    """Return the range of each rotation axis of a bone."""
    constraint = find_local_limit(bone, "LIMIT_ROTATION")
    return tuple(_rotation_range(bone, constraint, axis) for axis in range(3))


def unlimited_bones(armature_object: bpy.types.Object, rig: Rig) -> list[str]:
    """Return the joints that random poses rotate by the default angle about all axes, because they state no limits.

    Roots are left out: nothing limits how a character is turned.
    """
    bones = armature_object.pose.bones
    return [
        joint.name
        for joint in rig.joints
        if joint.name in bones
        and joint.parent >= 0
        and all(each.source == DEFAULT and not each.is_locked for each in rotation_ranges(bones[joint.name]))
    ]


def _rotation_range(bone: bpy.types.PoseBone, constraint: bpy.types.Constraint | None, axis: int) -> RotationRange:
    letter, is_locked = AXES[axis], bone.lock_rotation[axis]
    if constraint is not None:
        if getattr(constraint, f"use_limit_{letter}"):
            low, high = getattr(constraint, f"min_{letter}"), getattr(constraint, f"max_{letter}")
            return RotationRange(low, high, CONSTRAINT, is_locked)
    elif getattr(bone, f"lock_ik_{letter}"):
        return RotationRange(0.0, 0.0, DEFAULT, True)
    elif getattr(bone, f"use_ik_limit_{letter}"):
        return RotationRange(getattr(bone, f"ik_min_{letter}"), getattr(bone, f"ik_max_{letter}"), IK, is_locked)
    return RotationRange(*DEFAULT_RANGE, DEFAULT, is_locked)


def location_ranges(bone: bpy.types.PoseBone) -> dict[int, tuple[float, float]]:
    """Return the ranges, in meters, of the axes that a Limit Location constraint limits on both sides."""
    return _two_sided_limits(find_local_limit(bone, "LIMIT_LOCATION"))


def scale_ranges(bone: bpy.types.PoseBone) -> dict[int, tuple[float, float]]:
    """Return the ranges, as factors, of the axes that a Limit Scale constraint limits on both sides."""
    return _two_sided_limits(find_local_limit(bone, "LIMIT_SCALE"))


def _two_sided_limits(constraint: bpy.types.Constraint | None) -> dict[int, tuple[float, float]]:
    """Return the limits of the axes that a constraint limits on both sides; empty without a constraint."""
    limits = {axis: axis_limits(constraint, axis) for axis in range(3)} if constraint is not None else {}
    return {axis: bounds for axis, bounds in limits.items() if np.isfinite(bounds).all()}


def axis_limits(constraint: bpy.types.Constraint, axis: int) -> tuple[float, float]:
    """Return the lower and the upper limit that a Limit constraint sets on an axis; infinite where it has none."""
    letter = AXES[axis]
    # Limit Rotation has one switch for both sides of an axis.
    switches = (f"use_limit_{letter}",) * 2 if hasattr(constraint, f"use_limit_{letter}") else ()
    low_switch, high_switch = switches or (f"use_min_{letter}", f"use_max_{letter}")
    low = getattr(constraint, f"min_{letter}") if getattr(constraint, low_switch) else -np.inf
    return low, getattr(constraint, f"max_{letter}") if getattr(constraint, high_switch) else np.inf


def find_local_limit(bone: bpy.types.PoseBone, constraint_type: str) -> bpy.types.Constraint | None:
    """Find the Limit constraint of a type that stores the range of a bone; return None if there is none."""
    for constraint in bone.constraints:
        if constraint.type == constraint_type and constraint.owner_space == "LOCAL" and not constraint.mute:
            return constraint
    return None


def set_rotation_range(bone: bpy.types.PoseBone, axis: int, low: float, high: float) -> None:
    """Set the range of a rotation axis of a bone, and unlock the axis.

    The range replaces the bone's range where it is stored. A bone without a range gets IK limits, which do not restrict
    posing by hand. If the range does not include the rest pose, IK limits cannot express it, and the bone gets a Limit
    Rotation constraint.

    Args:
        axis: 0, 1 or 2.
        low, high: radians.

    Raises:
        RigError: the range is empty, or the bone's IK limits cannot express it.
    """
    if not low < high:
        raise RigError(f"The range of '{bone.name}' about {AXES[axis].upper()} is empty; give a larger maximum.")
    letter, constraint = AXES[axis], find_local_limit(bone, "LIMIT_ROTATION")
    has_ik_limits = any(rotation_range.source == IK for rotation_range in rotation_ranges(bone))
    if constraint is None and low <= 0 <= high:
        setattr(bone, f"lock_ik_{letter}", False)
        setattr(bone, f"use_ik_limit_{letter}", True)
        setattr(bone, f"ik_min_{letter}", low)
        setattr(bone, f"ik_max_{letter}", high)
    elif constraint is None and has_ik_limits:
        raise RigError(
            f"'{bone.name}' has IK limits, which must include the rest pose; begin at 0 or below and end at 0 or "
            "above, or give the bone a Limit Rotation constraint in local space."
        )
    else:
        if constraint is None:
            constraint = bone.constraints.new("LIMIT_ROTATION")
            constraint.owner_space = "LOCAL"
        set_constraint_limit(constraint, axis, low, high)
    bone.lock_rotation[axis] = False


def clear_rotation_range(bone: bpy.types.PoseBone, axis: int) -> None:
    """Remove the range of a rotation axis, so that it has the default range."""
    letter, constraint = AXES[axis], find_local_limit(bone, "LIMIT_ROTATION")
    if constraint is not None:
        setattr(constraint, f"use_limit_{letter}", False)
    else:
        setattr(bone, f"use_ik_limit_{letter}", False)
        setattr(bone, f"lock_ik_{letter}", False)


def set_constraint_limit(constraint: bpy.types.Constraint, axis: int, low: float, high: float) -> None:
    """Set the limits of one axis of a Limit constraint, in radians, meters or factors."""
    letter = AXES[axis]
    for name in (f"use_limit_{letter}", f"use_min_{letter}", f"use_max_{letter}"):
        if hasattr(constraint, name):
            setattr(constraint, name, True)
    setattr(constraint, f"min_{letter}", low)
    setattr(constraint, f"max_{letter}", high)


LIMIT_CONSTRAINTS = {"LIMIT_ROTATION", "LIMIT_LOCATION", "LIMIT_SCALE", "LIMIT_DISTANCE"}
_PROPERTY_NAMES = {ROTATION: "rotation_euler", LOCATION: "location", SCALE: "scale"}


def control_name(armature_object: bpy.types.Object, channel: Channel) -> str:
    """Return the name of the control (`Control.name`) for the number that a channel sets; empty if there is none."""
    bone = armature_object.pose.bones.get(channel.name)
    if channel.kind not in _PROPERTY_NAMES or bone is None:
        return ""
    if channel.kind == ROTATION and bone.rotation_mode in FOUR_COMPONENT_ROTATIONS:
        return ""
    escaped_name = bpy.utils.escape_identifier(channel.name)
    return f'{ARMATURE_OBJECT}/pose.bones["{escaped_name}"].{_PROPERTY_NAMES[channel.kind]}[{channel.axis}]'


def ranges_by_control(armature_object: bpy.types.Object, channels: Iterable[Channel]) -> dict[str, tuple[float, float]]:
    """Return the ranges of bone channels, by the names of the controls that set the same numbers."""
    ranges = {control_name(armature_object, channel): (channel.low, channel.high) for channel in channels}
    ranges.pop("", None)
    return ranges


def limited_bones(armature_object: bpy.types.Object) -> set[str]:
    """Return the deforming bones that have rotation limits and are not moved by constraints."""
    return {
        bone.name
        for bone in armature_object.pose.bones
        if bone.bone.use_deform
        and not is_moved_by_constraints(bone)
        and any(rotation.source != DEFAULT for rotation in rotation_ranges(bone))
    }


def is_moved_by_constraints(bone: bpy.types.PoseBone) -> bool:
    """Return whether a constraint other than a limit moves a bone."""
    return any(c.type not in LIMIT_CONSTRAINTS and not c.mute and c.influence > 0 for c in bone.constraints)
