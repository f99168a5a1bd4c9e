# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads the curves of actions: those of bones, and their values in frames."""

import re
from collections.abc import Iterator

import bpy
import numpy as np
from mathutils import Euler, Quaternion, Vector

from ..core.mathematics.poses import LOCATION, ROTATION, SCALE
from ..scene.action_slots import CurvesByDatablock
from ..scene.controls import canonical_path

_BONE_CHANNEL_PATH = re.compile(r'pose\.bones\["(?P<bone>(?:[^"\\]|\\.)*)"\]\.(?P<channel>\w+)')
_REST_VALUES = {
    "rotation_euler": (0.0, 0.0, 0.0),
    "rotation_quaternion": (1.0, 0.0, 0.0, 0.0),
    "rotation_axis_angle": (0.0, 0.0, 1.0, 0.0),
    LOCATION: (0.0, 0.0, 0.0),
    SCALE: (1.0, 1.0, 1.0),
}
"""Values of the channels that an action does not key."""
CurvesByChannel = dict[str, dict[int, bpy.types.FCurve]]
"""F-curves of a bone, by channel and array index."""


def curves_by_bone(armature_object: bpy.types.Object, action_curves: CurvesByDatablock) -> dict[str, CurvesByChannel]:
    """Return the F-curves of an action that animate locations, rotations and scales of the bones of an armature."""
    curves: dict[str, CurvesByChannel] = {}
    for curve in action_curves.get(armature_object, ()):
        match = _BONE_CHANNEL_PATH.fullmatch(canonical_path(armature_object, curve.data_path))
        name = bpy.utils.unescape_identifier(match["bone"]) if match else ""
        if match and match["channel"] in _REST_VALUES and name in armature_object.pose.bones:
            curves.setdefault(name, {}).setdefault(match["channel"], {})[curve.array_index] = curve
    return curves


def channel_values(
    bone: bpy.types.PoseBone, curves: CurvesByChannel, frames: range, rotations: dict[str, np.ndarray]
) -> Iterator[tuple[str, int, np.ndarray]]:
    """Evaluate the keyed channels of a bone.

    Args:
        curves: its F-curves.
        frames: F frames.
        rotations: receives the quaternions of a bone that is not keyed as Euler angles.

    Yields:
        Kind, axis and (F,) values of each channel.
    """
    for kind in (LOCATION, SCALE):
        for axis in curves.get(kind, {}):
            yield kind, axis, evaluate_curves(curves[kind], kind, frames)[:, axis]
    channel = {"QUATERNION": "rotation_quaternion", "AXIS_ANGLE": "rotation_axis_angle"}.get(bone.rotation_mode)
    channel = channel or "rotation_euler"
    keyed_curves = curves.get(channel)
    if keyed_curves:
        values = evaluate_curves(keyed_curves, channel, frames)
        if channel != "rotation_euler":
            if channel == "rotation_axis_angle":
                values = np.array([axis_angle_to_quaternion(value) for value in values])
            rotations[bone.name] = values.astype(np.float32)
        angles = _continuous_angles(channel, bone.rotation_mode, values)
        for axis in keyed_curves if channel == "rotation_euler" else range(3):
            yield ROTATION, axis, angles[:, axis]


def evaluate_curves(curves: dict[int, bpy.types.FCurve], channel: str, frames: range) -> np.ndarray:
    """Evaluate the F-curves of a channel, (F, 3 or 4) float64; components without an F-curve have their rest values."""
    values = np.tile(np.float64(_REST_VALUES[channel]), (len(frames), 1))
    for index, curve in curves.items():
        values[:, index] = [curve.evaluate(frame) for frame in frames]
    return values


def _continuous_angles(channel: str, rotation_mode: str, values: np.ndarray) -> np.ndarray:
    """Convert rotations to Euler angles, (F, 3) radians, that do not jump by 360 degrees between frames."""
    angles, euler = np.empty((len(values), 3)), Euler((0.0, 0.0, 0.0), "XYZ")
    for index, value in enumerate(values):
        if channel == "rotation_euler":
            euler = Euler(value, rotation_mode)
            if index:
                euler.make_compatible(Euler(angles[index - 1], rotation_mode))
        else:
            quaternion = Quaternion(value)
            # A quaternion of length 0 is no rotation, as in Blender.
            unit_quaternion = quaternion.normalized() if quaternion.magnitude else Quaternion()
            euler = unit_quaternion.to_euler("XYZ", euler)
        angles[index] = euler
    return angles


def axis_angle_to_quaternion(value: np.ndarray) -> Quaternion:
    axis = Vector(value[1:])
    return Quaternion(axis, value[0]) if axis.length else Quaternion()
