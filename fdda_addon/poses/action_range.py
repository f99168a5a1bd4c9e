# SPDX-License-Identifier: GPL-3.0-or-later
"""How far actions move a rig: ranges of the channels of its bones and of its controls, measured from the F-curves.

Nothing is evaluated and the scene is not touched.
"""

import hashlib
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass

import bpy
import numpy as np
from mathutils import Euler, Quaternion, Vector

from ..core.controls import ARMATURE, ARMATURE_OBJECT, MESH_OBJECT, SHAPE_KEYS, Control
from ..core.errors import RigError
from ..core.poses import CONTROL, LOCATION, RANGE_TOLERANCE, ROTATION, ROTATION_VECTOR, SCALE, Channel
from ..core.rotations import euler_angles, rotation_vectors, total_range_width
from ..scene.arrays import KEYFRAME, read
from ..scene.compatibility import curves_of
from ..scene.controls import is_driven, is_number, make_control, owner_of
from ..scene.scene_rig import SceneRig

_OF_BONE = re.compile(r'pose\.bones\["(?P<bone>(?:[^"\\]|\\.)*)"\]\.(?P<channel>\w+)')
_CONTROL = re.compile(r'.*(?:\]\.influence|key_blocks\["(?:[^"\\]|\\.)*"\]\.value|\["(?:[^"\\]|\\.)*"\])')
_REST = {
    "rotation_euler": (0.0, 0.0, 0.0),
    "rotation_quaternion": (1.0, 0.0, 0.0, 0.0),
    "rotation_axis_angle": (0.0, 0.0, 1.0, 0.0),
    LOCATION: (0.0, 0.0, 0.0),
    SCALE: (1.0, 1.0, 1.0),
}
"""What an action leaves a channel at that it does not key."""

MAX_MEASURED_BYTES = 64_000_000
"""Rotations of actions that are kept; beyond so many bytes all are measured again."""
CONTINUOUS_PREFERENCE = 0.9
"""Angles that follow on from frame to frame are taken unless others have ranges that are narrower by this factor."""

Ranges = dict[tuple[str, str, int], tuple[float, float]]
"""Lowest and highest value by bone, kind and axis."""

Curves = dict[str, dict[int, bpy.types.FCurve]]
"""F-curves of a bone by channel and index."""


@dataclass(frozen=True)
class _Measured:
    """What an action keys.

    Attributes:
        content: the keys that it was measured of; None where it follows from more than the keys.
        ranges: of all channels, Euler angles as they follow on from frame to frame.
        rotations: (F, 4) float32 quaternions of the bones that are not keyed as Euler angles.
    """

    content: tuple | None
    ranges: Ranges
    rotations: dict[str, np.ndarray]


_measured: dict[tuple[int, int], _Measured] = {}
"""By session_uid of the armature object and of the action."""


def action_frames(action: bpy.types.Action) -> range:
    """The whole frames of an action."""
    first, last = (round(frame) for frame in action.frame_range)
    return range(first, last + 1)


def measured_ranges(armature_object: bpy.types.Object, actions: Iterable[bpy.types.Action]) -> Ranges:
    """How far actions move the bones of an armature, over all their whole frames.

    Args:
        armature_object: the armature object.
        actions: the actions.

    Returns:
        Lowest and highest value by bone, kind and axis, of what the actions key and move: `ROTATION` in radians, the
        Euler angles as `armature.Poser` sets them (in the order of the bone, of quaternions and axis angles XYZ, and
        turning on beyond a half turn), `LOCATION` in metres and `SCALE` as factors, relative to the rest pose.
    """
    return moving_ranges(keyed_ranges(armature_object, actions))


def moving_ranges(keyed: Ranges) -> Ranges:
    """Of the ranges that `keyed_ranges` returns those of `measured_ranges`."""
    return {key: bounds for key, bounds in keyed.items() if key[1] != ROTATION_VECTOR and has_width(bounds)}


def has_width(bounds: tuple[float, float]) -> bool:
    """Whether a range is more than a point."""
    return bounds[1] - bounds[0] > RANGE_TOLERANCE


def keyed_ranges(armature_object: bpy.types.Object, actions: Iterable[bpy.types.Action]) -> Ranges:
    """As `measured_ranges`, also of what is keyed and stands still, and with `ROTATION_VECTOR`s.

    Bones that are keyed as quaternions or axis angles have rotation vectors beside their Euler angles. Three Euler
    angles wrap, and widen near gimbal lock. The ranges of rotation vectors are about as wide as the motion.
    """
    found: Ranges = {}
    rotations: dict[str, list[np.ndarray]] = {}
    for measured in [_measure(armature_object, action) for action in actions]:
        for key, (low, high) in measured.ranges.items():
            lowest, highest = found.get(key, (np.inf, -np.inf))
            found[key] = min(lowest, low), max(highest, high)
        for bone, own in measured.rotations.items():
            rotations.setdefault(bone, []).append(own)
    for bone, parts in rotations.items():
        quaternions = np.concatenate(parts)
        angles = euler_angles(quaternions)
        width = sum(high - low for low, high in (found[bone, ROTATION, axis] for axis in range(3)))
        if total_range_width(angles) < CONTINUOUS_PREFERENCE * width:
            found |= _by_axis(bone, ROTATION, angles)
        found |= _by_axis(bone, ROTATION_VECTOR, rotation_vectors(quaternions))
    return found


def _by_axis(bone: str, kind: str, values: np.ndarray) -> Ranges:
    bounds = zip(values.min(axis=0).tolist(), values.max(axis=0).tolist(), strict=True)
    return {(bone, kind, axis): ends for axis, ends in enumerate(bounds)}


def _measure(armature_object: bpy.types.Object, action: bpy.types.Action) -> _Measured:
    """Measure an action; again when its keys have changed, for one of many bones takes a second."""
    frames, curves = action_frames(action), _curves_by_bone(armature_object, action)
    content = _content(armature_object, frames, curves)
    place = armature_object.session_uid, action.session_uid
    known = _measured.get(place)
    if content is None or known is None or known.content != content:
        known = _Measured(content, {}, {})
        for bone, own in curves.items():
            for kind, axis, values in _channels(armature_object.pose.bones[bone], own, frames, known.rotations):
                known.ranges[bone, kind, axis] = float(values.min()), float(values.max())
        if sum(array.nbytes for each in _measured.values() for array in each.rotations.values()) > MAX_MEASURED_BYTES:
            _measured.clear()
        _measured[place] = known
    return known


def _content(
    armature_object: bpy.types.Object, frames: range, curves: dict[str, Curves]
) -> tuple[range, bytes, tuple] | None:
    """What ranges follow from; None where that is more than the keys."""
    digest, places = hashlib.sha256(), []
    for bone, channels in curves.items():
        for channel, by_index in channels.items():
            for index, curve in by_index.items():
                points = curve.keyframe_points
                if curve.modifiers or not points:
                    return None
                places.append((bone, armature_object.pose.bones[bone].rotation_mode, channel, index, len(points)))
                places.append(curve.extrapolation)
                for element in KEYFRAME:
                    digest.update(read(points, element))
    return frames, digest.digest(), tuple(places)


def measured_controls(scene_rig: SceneRig, actions: Iterable[bpy.types.Action]) -> tuple[Control, ...]:
    """The numbers of a rig that actions key and move, beside its bones, with the ranges they move in.

    Custom properties, influences of constraints and values of shape keys count. What a file lacks, or what is wider
    than any control, is left out.

    Args:
        scene_rig: the rig.
        actions: the actions.
    """
    controls = []
    for (owner, path), bounds in _keyed_controls(scene_rig, actions).items():
        if has_width(bounds):
            with suppress(RigError):
                controls.append(make_control(scene_rig, owner, path, bounds))
    return tuple(controls)


def constant_controls(scene_rig: SceneRig, actions: Iterable[bpy.types.Action]) -> tuple[Channel, ...]:
    """The numbers as of `measured_controls` that actions key at one value, where the file has another value now."""
    channels = []
    for (owner, path), (low, high) in _keyed_controls(scene_rig, actions).items():
        datablock = owner_of(scene_rig, owner)
        if is_number(datablock, path) and not has_width((low, high)):
            channel = Channel(f"{owner}/{path}", CONTROL, 0, low, low)
            if abs(float(datablock.path_resolve(path)) - low) > RANGE_TOLERANCE and not is_driven(datablock, path):
                channels.append(channel)
    return tuple(channels)


def _keyed_controls(
    scene_rig: SceneRig, actions: Iterable[bpy.types.Action]
) -> dict[tuple[str, str], tuple[float, float]]:
    """Lowest and highest value by owner and path."""
    found: dict[tuple[str, str], tuple[float, float]] = {}
    for action in actions:
        frames = action_frames(action)
        for owner in (ARMATURE_OBJECT, ARMATURE, MESH_OBJECT, SHAPE_KEYS):
            datablock = owner_of(scene_rig, owner)
            for curve in _playing_curves(action, datablock) if datablock else ():
                if _CONTROL.fullmatch(curve.data_path):
                    values = [curve.evaluate(frame) for frame in frames]
                    low, high = found.get((owner, curve.data_path), (np.inf, -np.inf))
                    found[owner, curve.data_path] = min(low, *values), max(high, *values)
    return found


def _curves_by_bone(armature_object: bpy.types.Object, action: bpy.types.Action) -> dict[str, Curves]:
    found: dict[str, Curves] = {}
    for curve in _playing_curves(action, armature_object):
        match = _OF_BONE.fullmatch(curve.data_path)
        name = bpy.utils.unescape_identifier(match["bone"]) if match else ""
        if match and match["channel"] in _REST and name in armature_object.pose.bones:
            found.setdefault(name, {}).setdefault(match["channel"], {})[curve.array_index] = curve
    return found


def _playing_curves(action: bpy.types.Action, datablock: bpy.types.ID) -> Iterator[bpy.types.FCurve]:
    """The F-curves of a datablock that are not muted, by themselves or with their group."""
    for curve in curves_of(action, datablock):
        if not (curve.mute or (curve.group and curve.group.mute)):
            yield curve


def _channels(
    bone: bpy.types.PoseBone, curves: Curves, frames: range, rotations: dict[str, np.ndarray]
) -> Iterator[tuple[str, int, np.ndarray]]:
    """Kind, axis and (F,) values over the frames of what is keyed; quaternions are put into `rotations`."""
    for kind in (LOCATION, SCALE):
        for axis in curves.get(kind, {}):
            yield kind, axis, _values(curves[kind], kind, frames)[:, axis]
    channel = {"QUATERNION": "rotation_quaternion", "AXIS_ANGLE": "rotation_axis_angle"}.get(bone.rotation_mode)
    channel = channel or "rotation_euler"
    keyed = curves.get(channel)
    if keyed:
        values = _values(keyed, channel, frames)
        if channel != "rotation_euler":
            values = values if channel == "rotation_quaternion" else np.array([_of_axis_angle(v) for v in values])
            rotations[bone.name] = values.astype(np.float32)
        angles = _continuous_angles(channel, bone.rotation_mode, values)
        for axis in keyed if channel == "rotation_euler" else range(3):
            yield ROTATION, axis, angles[:, axis]


def _values(curves: dict[int, bpy.types.FCurve], channel: str, frames: range) -> np.ndarray:
    """(F, 3 or 4) float64 values of a channel over the frames."""
    values = np.tile(np.float64(_REST[channel]), (len(frames), 1))
    for index, curve in curves.items():
        values[:, index] = [curve.evaluate(frame) for frame in frames]
    return values


def _continuous_angles(channel: str, mode: str, values: np.ndarray) -> np.ndarray:
    """(F, 3) Euler angles in radians that do not jump by a turn from one frame to the next."""
    angles, previous = np.empty((len(values), 3)), Euler((0.0, 0.0, 0.0), "XYZ")
    for place, value in enumerate(values):
        if channel == "rotation_euler":
            previous = Euler(value, mode)
            if place:
                previous.make_compatible(Euler(angles[place - 1], mode))
        else:
            turned = Quaternion(value)
            # A quaternion of length 0 turns nothing, in Blender as well.
            previous = (turned.normalized() if turned.magnitude else Quaternion()).to_euler("XYZ", previous)
        angles[place] = previous
    return angles


def _of_axis_angle(value: np.ndarray) -> Quaternion:
    axis = Vector(value[1:])
    return Quaternion(axis, value[0]) if axis.length else Quaternion()
