# SPDX-License-Identifier: GPL-3.0-or-later
"""Converts between channels of bones and controls: both are numbers of the armature object."""

from collections.abc import Iterable

import bpy

from ..core.controls import ARMATURE_OBJECT
from ..core.poses import LOCATION, ROTATION, SCALE, Channel

_PATHS = {ROTATION: "rotation_euler", LOCATION: "location", SCALE: "scale"}


def control_name(armature_object: bpy.types.Object, channel: Channel) -> str:
    """Return the name of the control (`Control.name`) for the number that a channel sets; empty if there is none."""
    bone = armature_object.pose.bones.get(channel.name)
    if channel.kind not in _PATHS or bone is None:
        return ""
    if channel.kind == ROTATION and bone.rotation_mode in {"QUATERNION", "AXIS_ANGLE"}:
        return ""
    escaped = bpy.utils.escape_identifier(channel.name)
    return f'{ARMATURE_OBJECT}/pose.bones["{escaped}"].{_PATHS[channel.kind]}[{channel.axis}]'


def ranges_by_control(armature_object: bpy.types.Object, channels: Iterable[Channel]) -> dict[str, tuple[float, float]]:
    """Return the ranges of channels of bones by the names of the controls for the same numbers."""
    ranges = {control_name(armature_object, channel): (channel.low, channel.high) for channel in channels}
    ranges.pop("", None)
    return ranges
