# SPDX-License-Identifier: GPL-3.0-or-later
"""Measures the ranges in which actions move the bones and controls of a rig, from their F-curves.

The measurement reads F-curves only: it does not evaluate or change the scene.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from typing import TypeVar

import bpy
import numpy as np
from mathutils import Euler, Quaternion, Vector

from ..core.controls import OTHER_OBJECT, Control
from ..core.errors import RigError
from ..core.mathematics.poses import CONTROL, LOCATION, RANGE_TOLERANCE, ROTATION, ROTATION_VECTOR, SCALE, Channel
from ..core.mathematics.rotations import rotation_vectors
from ..scene.action_slots import CurvesByDatablock, curves_of_actions
from ..scene.armature import FOUR_COMPONENT_ROTATIONS
from ..scene.arrays import REST_MATRIX_ELEMENT, read
from ..scene.controls import canonical_path, is_driven, is_number, make_control, owner_name, owner_of
from ..scene.draw_cache import actions_state, computed_once
from ..scene.scene_rig import SceneRig

_CONTROL_PATH = re.compile(r'.*(?:\]\.influence|key_blocks\["(?:[^"\\]|\\.)*"\]\.value|\["(?:[^"\\]|\\.)*"\])')

Value = TypeVar("Value")
ChannelRanges = dict[tuple[str, str, int], tuple[float, float]]
"""Lowest and highest value of channels, by bone, kind and axis."""


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
    channel = FOUR_COMPONENT_ROTATIONS.get(bone.rotation_mode, "rotation_euler")
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


def action_frames(action: bpy.types.Action) -> range:
    """Return the whole frames of an action."""
    first_frame, last_frame = (round(frame) for frame in action.frame_range)
    return range(first_frame, last_frame + 1)


def measured_ranges(armature_object: bpy.types.Object, actions: Iterable[bpy.types.Action]) -> ChannelRanges:
    """Measure the ranges in which actions move the bones of an armature, at all whole frames.

    Returns:
        Ranges of the channels that the actions key and change, relative to the rest pose: `ROTATION` in radians,
        `LOCATION` in meters, `SCALE` as factors. Rotations are Euler angles as `armature.Poser` sets them: in the
        rotation order of the bone (XYZ for quaternions and axis angles), and continuous beyond 180 degrees.
    """
    ranges = keyed_ranges(armature_object, actions)
    return {key: bounds for key, bounds in ranges.items() if key[1] != ROTATION_VECTOR and has_width(bounds)}


def has_width(bounds: tuple[float, float]) -> bool:
    """Return whether a range contains more than one value."""
    return bounds[1] - bounds[0] > RANGE_TOLERANCE


def keyed_ranges(armature_object: bpy.types.Object, actions: Iterable[bpy.types.Action]) -> ChannelRanges:
    """Measure ranges as `measured_ranges` does, including constant channels and rotation vectors (`ROTATION_VECTOR`).

    Bones that are keyed as quaternions or axis angles have rotation vectors besides their Euler angles. Euler angles
    wrap, and have wide ranges near gimbal lock; the ranges of rotation vectors are about as wide as the motion.
    """
    actions = list(actions)
    return computed_for_actions(
        "ranges", (armature_object,), actions, lambda: _measure_ranges(armature_object, actions)
    )


def _measure_ranges(armature_object: bpy.types.Object, actions: list[bpy.types.Action]) -> ChannelRanges:
    ranges: ChannelRanges = {}
    rotations: dict[str, list[np.ndarray]] = {}
    for action, curves in zip(actions, curves_of_actions(actions, armature_object), strict=True):
        keyed_rotations: dict[str, np.ndarray] = {}
        for name, bone_curves in curves_by_bone(armature_object, curves).items():
            bone = armature_object.pose.bones[name]
            for kind, axis, values in channel_values(bone, bone_curves, action_frames(action), keyed_rotations):
                lowest, highest = ranges.get((name, kind, axis), (np.inf, -np.inf))
                ranges[name, kind, axis] = min(lowest, float(values.min())), max(highest, float(values.max()))
        for bone, quaternions in keyed_rotations.items():
            rotations.setdefault(bone, []).append(quaternions)
    for bone, arrays in rotations.items():
        vectors = rotation_vectors(np.concatenate(arrays))
        bounds = zip(vectors.min(axis=0).tolist(), vectors.max(axis=0).tolist(), strict=True)
        ranges |= {(bone, ROTATION_VECTOR, axis): low_high for axis, low_high in enumerate(bounds)}
    return ranges


def computed_for_actions(
    name: str, datablocks: Sequence[bpy.types.Object], actions: Sequence[bpy.types.Action], compute: Callable[[], Value]
) -> Value:
    """Return what follows from actions and the rest pose of an armature; it is computed again if one of them changes.

    The sidebar asks with every check of a rig, and dozens of actions take seconds.

    Args:
        name: what is computed.
        datablocks: the armature object, and what else the value depends on.
        compute: returns the value.
    """
    bones, animation = datablocks[0].pose.bones, datablocks[0].animation_data
    state = (
        actions_state(),
        animation and animation.action and animation.action.session_uid,
        [(bone.name, bone.rotation_mode, *bone.lock_rotation, bone.bone.use_local_location) for bone in bones],
        read(datablocks[0].data.bones, REST_MATRIX_ELEMENT).tobytes(),
        [tuple(action.frame_range) for action in actions],
    )
    key = (name, *(d.session_uid for d in (*datablocks, *actions)))
    return computed_once(key, state, compute)


def measured_controls(scene_rig: SceneRig, actions: Iterable[bpy.types.Action]) -> tuple[Control, ...]:
    """Measure the numbers of a rig, besides its bones, that actions key and change, as controls with their ranges.

    These are custom properties, influences of constraints and values of shape keys. Numbers that do not exist
    in the file, and numbers whose range is too wide for a control, are left out.
    """
    controls = []
    for (owner, path), bounds in keyed_controls(scene_rig, actions).items():
        if has_width(bounds):
            with suppress(RigError):
                controls.append(make_control(scene_rig, owner, path, bounds))
    return tuple(controls)


def constant_controls(scene_rig: SceneRig, actions: Iterable[bpy.types.Action]) -> tuple[Channel, ...]:
    """Find numbers of a rig that actions key at a single value other than the current one, as constant channels."""
    channels = []
    for (owner, path), (low, high) in keyed_controls(scene_rig, actions).items():
        datablock = owner_of(scene_rig, owner)
        if is_number(datablock, path) and not has_width((low, high)):
            channel = Channel(f"{owner}/{path}", CONTROL, 0, low, low)
            if abs(float(datablock.path_resolve(path)) - low) > RANGE_TOLERANCE and not is_driven(datablock, path):
                channels.append(channel)
    return tuple(channels)


def keyed_controls(
    scene_rig: SceneRig, actions: Iterable[bpy.types.Action]
) -> dict[tuple[str, str], tuple[float, float]]:
    """Measure the lowest and highest value of keyed numbers, by owner and path."""
    ranges: dict[tuple[str, str], tuple[float, float]] = {}
    for numbers in keyed_numbers(scene_rig, actions):
        for key, values in numbers.items():
            low, high = ranges.get(key, (np.inf, -np.inf))
            ranges[key] = min(low, float(values.min())), max(high, float(values.max()))
    return ranges


def keyed_numbers(scene_rig: SceneRig, actions: Iterable[bpy.types.Action]) -> list[dict[tuple[str, str], np.ndarray]]:
    """Evaluate the numbers, besides the channels of bones, that actions key.

    Returns:
        For each action, (F,) float64 values in its frames, by owner and path as in `Control`.
    """
    actions = list(actions)
    return computed_for_actions(
        "numbers",
        (scene_rig.armature_object, *scene_rig.mesh_objects),
        actions,
        lambda: _evaluate_numbers(scene_rig, actions),
    )


def _evaluate_numbers(scene_rig: SceneRig, actions: list[bpy.types.Action]) -> list[dict[tuple[str, str], np.ndarray]]:
    numbers_by_action = []
    curves_by_action = curves_of_actions(actions, *scene_rig.mesh_objects, scene_rig.armature_object)
    for action, curves in zip(actions, curves_by_action, strict=True):
        frames, numbers = action_frames(action), {}
        for datablock, datablock_curves in curves.items():
            owner = owner_name(scene_rig, datablock)
            if not owner or owner.startswith(OTHER_OBJECT):
                continue
            for curve in datablock_curves:
                path = canonical_path(datablock, curve.data_path)
                if _CONTROL_PATH.fullmatch(path):
                    numbers[owner, path] = np.array([curve.evaluate(frame) for frame in frames])
        numbers_by_action.append(numbers)
    return numbers_by_action
