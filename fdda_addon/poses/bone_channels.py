# SPDX-License-Identifier: GPL-3.0-or-later
"""Relates channels of bones to controls and constraints, which may set the same numbers of the armature object."""

from collections.abc import Iterable

import bpy

from ..core.controls import ARMATURE_OBJECT
from ..core.mathematics.poses import LOCATION, ROTATION, SCALE, Channel

LIMIT_CONSTRAINTS = {"LIMIT_ROTATION", "LIMIT_LOCATION", "LIMIT_SCALE", "LIMIT_DISTANCE"}
_PROPERTY_NAMES = {ROTATION: "rotation_euler", LOCATION: "location", SCALE: "scale"}


def control_name(armature_object: bpy.types.Object, channel: Channel) -> str:
    """Return the name of the control (`Control.name`) for the number that a channel sets; empty if there is none."""
    bone = armature_object.pose.bones.get(channel.name)
    if channel.kind not in _PROPERTY_NAMES or bone is None:
        return ""
    if channel.kind == ROTATION and bone.rotation_mode in {"QUATERNION", "AXIS_ANGLE"}:
        return ""
    escaped_name = bpy.utils.escape_identifier(channel.name)
    return f'{ARMATURE_OBJECT}/pose.bones["{escaped_name}"].{_PROPERTY_NAMES[channel.kind]}[{channel.axis}]'


def ranges_by_control(armature_object: bpy.types.Object, channels: Iterable[Channel]) -> dict[str, tuple[float, float]]:
    """Return the ranges of bone channels, by the names of the controls that set the same numbers."""
    ranges = {control_name(armature_object, channel): (channel.low, channel.high) for channel in channels}
    ranges.pop("", None)
    return ranges


def is_moved_by_constraints(bone: bpy.types.PoseBone) -> bool:
    """Return whether a constraint other than a limit moves a bone."""
    return any(c.type not in LIMIT_CONSTRAINTS and not c.mute and c.influence > 0 for c in bone.constraints)
