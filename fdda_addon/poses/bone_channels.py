# SPDX-License-Identifier: GPL-3.0-or-later
"""Channels of bones as numbers of the armature object: what a channel and a control have in common."""

from collections.abc import Iterable

import bpy

from ..core.controls import ARMATURE_OBJECT
from ..core.poses import LOCATION, ROTATION, SCALE, Channel

_PATHS = {ROTATION: "rotation_euler", LOCATION: "location", SCALE: "scale"}


def control_name(armature_object: bpy.types.Object, channel: Channel) -> str:
    """The name of the control (`Control.name`) that is the number which a channel of a bone sets; empty for none."""
    bone = armature_object.pose.bones.get(channel.name)
    if channel.kind not in _PATHS or bone is None:
        return ""
    if channel.kind == ROTATION and bone.rotation_mode in {"QUATERNION", "AXIS_ANGLE"}:
        return ""
    escaped = bpy.utils.escape_identifier(channel.name)
    return f'{ARMATURE_OBJECT}/pose.bones["{escaped}"].{_PATHS[channel.kind]}[{channel.axis}]'


def ranges_by_control(armature_object: bpy.types.Object, channels: Iterable[Channel]) -> dict[str, tuple[float, float]]:
    """Ranges of the numbers that channels of bones set, by the names of controls."""
    found = {control_name(armature_object, channel): (channel.low, channel.high) for channel in channels}
    found.pop("", None)
    return found
