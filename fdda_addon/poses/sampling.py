# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the channels that random poses set: bones in their ranges of motion, and controls."""

from collections.abc import Callable, Iterable
from dataclasses import replace

import bpy

from ..core.controls import Control
from ..core.errors import RigError
from ..core.formats.model_info import ModelInfo
from ..core.mathematics.poses import (
    CHANNEL_KINDS,
    CONTROL,
    LOCATION,
    ROTATION,
    ROTATION_VECTOR,
    SCALE,
    Channel,
)
from ..core.mathematics.remix import replace_bone_channels
from ..core.rig import Rig
from ..scene.controls import can_be_set, driven_numbers, is_driven, is_number, owner_of
from ..scene.scene_rig import SceneRig
from .action_range import ChannelRanges, has_width
from .motion_range import (
    DEFAULT,
    RotationRange,
    control_name,
    is_moved_by_constraints,
    location_ranges,
    ranges_by_control,
    rotation_ranges,
    scale_ranges,
)
from .sample_selection import DEFAULT_SELECTION, SampleSelection, bone_controls, select_bones

ControlRanges = dict[str, tuple[float, float]]
"""Ranges by the names of controls."""


def parse_sample_selection(
    scene_rig: SceneRig,
    texts: Iterable[str],
    find_controls: Callable[[ControlRanges], Iterable[Control]],
    control_bones: frozenset[str] = frozenset(),
    recorded_actions: Iterable[bpy.types.Action] = (),
) -> SampleSelection:
    """Parse the user's selection of bones and controls.

    Args:
        texts: `selected` for the selected bones, `collection:NAME` for the bones of a collection and its children,
            `action:NAME` for all bones and controls that an action keys, or `bone:NAME`; empty for the default bones.
        find_controls: returns further controls, given the ranges of the sampled numbers of bones (`ranges_by_control`),
            which may be controls too.
        control_bones, recorded_actions: as for `select_bones`.

    Raises:
        RigError: there is no such collection, action or bone, or the selection is empty.
    """
    texts = list(texts)
    selection = select_bones(scene_rig, texts, control_bones, recorded_actions)
    controls = {control.name: control for control in selection.controls}
    controls |= {control.name: control for control in controls_of_bones(scene_rig, selection)}
    controls |= {control.name: control for control in find_controls(sampled_numbers(scene_rig, selection))}
    selection = replace(selection, controls=tuple(controls.values()))
    has_bones = selection.bones is None or selection.bones - selection.action_bones
    if not controls and not has_bones and not any(has_width(bounds) for _, bounds in selection.measured):
        raise RigError(f"Nothing is chosen to sample by {', '.join(texts)}; choose bones that an animator poses.")
    return selection


def controls_of_bones(scene_rig: SceneRig, selection: SampleSelection) -> tuple[Control, ...]:
    """Return the controls of the control bones of a selection."""
    channels = _bone_channels(scene_rig.armature_object, selection, set())
    return bone_controls(scene_rig, selection.control_bones, channels)


def sampled_numbers(scene_rig: SceneRig, selection: SampleSelection) -> ControlRanges:
    """Return the ranges of the numbers of bones that are sampled, by the names of the controls for these numbers."""
    return ranges_by_control(scene_rig.armature_object, _bone_channels(scene_rig.armature_object, selection, set()))


def sampled_channels(
    scene_rig: SceneRig, rig: Rig, selection: SampleSelection = DEFAULT_SELECTION
) -> tuple[Channel, ...]:
    """Find the channels of a random pose.

    Args:
        selection: the user's selection.

    Raises:
        RigError: there is no channel.
    """
    armature_object = scene_rig.armature_object
    controls = {control.name: (control.low, control.high) for control in selection.controls}
    channels = []
    for channel in _bone_channels(armature_object, selection, {*rig.joint_names, *selection.key_bones}):
        # A control that is a number of a bone is set with the bone, in the range of the control.
        bounds = controls.pop(control_name(armature_object, channel), (channel.low, channel.high))
        channels.append(replace(channel, low=bounds[0], high=bounds[1]))
    key_owners = {control.owner for control in selection.controls if control.is_shape_key}
    driven_keys = {owner: driven_numbers(owner_of(scene_rig, owner)) for owner in key_owners}
    for control in selection.controls:
        # There may be hundreds of shape keys.
        is_set = (
            (control.path, 0) in driven_keys[control.owner]
            if control.is_shape_key
            else is_driven(owner_of(scene_rig, control.owner), control.path)
        )
        if control.name in controls and can_be_set(control.name) and not is_set:
            channels.append(Channel(control.name, CONTROL, 0, control.low, control.high))
    control_names = {control.name for control in selection.controls}
    channels += [channel for channel in selection.constant_channels if channel.name not in control_names]
    if not channels:
        raise RigError(
            f"No bone of '{armature_object.name}' may be sampled: all {len(rig.joints)} are locked or moved by "
            "constraints; unlock an axis, give it a Limit Rotation, choose the bones that an animator poses "
            "(--bones-to-pose), or record actions alone, with 0 random poses (--action NAME --poses 0)."
        )
    return tuple(channels)


def _bone_channels(
    armature_object: bpy.types.Object, selection: SampleSelection, names: set[str]
) -> tuple[Channel, ...]:
    """Return the channels of the bones of a selection; `names` is passed to `default_channels`."""
    if selection.bones is not None:
        channels = selected_channels(armature_object, selection)
        return channels if selection.remix is None else replace_bone_channels(channels, selection.remix.channels)
    channels = default_channels(armature_object, names)
    if not selection.control_bones:
        return channels
    control_channels = selected_channels(armature_object, replace(selection, bones=selection.control_bones))
    return (*(channel for channel in channels if channel.name not in selection.control_bones), *control_channels)


def model_channels(scene_rig: SceneRig, rig: Rig, info: ModelInfo) -> tuple[Channel, ...]:
    """Return the channels of a model's random poses, or the channels of the rig if the model has none.

    Raises:
        RigError: the rig lacks a channel, or there is no channel.
    """
    bones = scene_rig.armature_object.pose.bones
    for channel in info.limits:
        owner, _, path = channel.name.partition("/")
        if channel.kind == CONTROL:
            has_channel = is_number(owner_of(scene_rig, owner), path)
        else:
            has_channel = channel.name in bones and channel.kind in CHANNEL_KINDS
        if not has_channel or channel.axis not in range(3):
            raise RigError(
                f"'{scene_rig.armature_object.name}' lacks '{channel.name}', which the random poses of the model "
                "moved; name it as before, or record and train this rig."
            )
    return info.limits or sampled_channels(scene_rig, rig)


def _are_free(rotations: tuple[RotationRange, ...]) -> bool:
    """Return whether no rotation axis of a bone is locked or limited."""
    return all(rotation.source == DEFAULT and not rotation.is_locked for rotation in rotations)


def default_channels(armature_object: bpy.types.Object, names: set[str]) -> tuple[Channel, ...]:
    """Find the channels of the default bones, in their ranges of motion.

    These are the bones with a range of motion and those in `names`. Locked axes are left out. Bones with
    constraints other than limits are left out too, because setting their channels may have no effect.

    Args:
        names: names of bones to include even if they have no range of motion.
    """
    channels = []
    for bone in armature_object.pose.bones:
        if is_moved_by_constraints(bone):
            continue
        ranges = rotation_ranges(bone)
        if bone.name in names or any(r.source != DEFAULT for r in ranges):
            channels += _rotation_channels(bone, {axis: (r.low, r.high) for axis, r in enumerate(ranges) if r.moves})
        channels += _location_and_scale_channels(bone)
    return tuple(channels)


def selected_channels(armature_object: bpy.types.Object, selection: SampleSelection) -> tuple[Channel, ...]:
    """Find the channels of the bones that a user selected, even of bones with constraints.

    Bones that are selected by an action have only the channels that the action keys, in its ranges, narrowed by the
    limits of the bone. A channel that is keyed at a constant value other than its rest value keeps this value.
    """
    ranges_by_bone: dict[str, ChannelRanges] = {}
    for key, bounds in selection.measured:
        ranges_by_bone.setdefault(key[0], {})[key] = bounds
    channels = []
    for bone in armature_object.pose.bones:
        if bone.name not in selection.bones:
            continue
        keyed_channel_ranges, is_action_bone = ranges_by_bone.get(bone.name, {}), bone.name in selection.action_bones
        if not is_action_bone:
            keyed_channel_ranges = {key: bounds for key, bounds in keyed_channel_ranges.items() if has_width(bounds)}
        channels += _selected_rotation_channels(bone, keyed_channel_ranges, is_action_bone)
        channels += _selected_location_and_scale_channels(bone, keyed_channel_ranges, is_action_bone)
    return tuple(channels)


def _selected_rotation_channels(
    bone: bpy.types.PoseBone, keyed_channel_ranges: ChannelRanges, is_action_bone: bool
) -> list[Channel]:
    limits = rotation_ranges(bone)
    rotation_vector_ranges = {
        key[2]: bounds for key, bounds in keyed_channel_ranges.items() if key[1] == ROTATION_VECTOR
    }
    if rotation_vector_ranges and _are_free(limits):
        return _without_fixed_channels(
            Channel(bone.name, ROTATION_VECTOR, axis, *bounds) for axis, bounds in rotation_vector_ranges.items()
        )
    ranges: dict[int, tuple[float, float]] = {}
    for axis, limit in enumerate(limits):
        keyed_range = keyed_channel_ranges.get((bone.name, ROTATION, axis))
        if limit.is_locked:
            continue
        if keyed_range and limit.source == DEFAULT:
            ranges[axis] = keyed_range
        elif keyed_range and is_action_bone:
            ranges[axis] = _clamp_range(keyed_range, (limit.low, limit.high))
        elif limit.moves and not is_action_bone:
            ranges[axis] = (limit.low, limit.high)
    return _without_fixed_channels(_rotation_channels(bone, ranges))


def _selected_location_and_scale_channels(
    bone: bpy.types.PoseBone, keyed_channel_ranges: ChannelRanges, is_action_bone: bool
) -> list[Channel]:
    channels = {} if is_action_bone else {(c.kind, c.axis): c for c in _location_and_scale_channels(bone)}
    limits, locks = _location_and_scale_ranges(bone), {LOCATION: bone.lock_location, SCALE: bone.lock_scale}
    for (name, kind, axis), bounds in keyed_channel_ranges.items():
        # A connected bone cannot move away from the tail of its parent.
        if kind in locks and not locks[kind][axis] and not (kind == LOCATION and bone.bone.use_connect):
            clamped_range = _clamp_range(bounds, limits[kind, axis]) if (kind, axis) in limits else bounds
            channels.setdefault((kind, axis), Channel(name, kind, axis, *clamped_range))
    return _without_fixed_channels(channels.values())


def _clamp_range(bounds: tuple[float, float], limit: tuple[float, float]) -> tuple[float, float]:
    """Clamp both ends of a range to a limit."""
    return tuple(min(max(end, limit[0]), limit[1]) for end in bounds)


def _without_fixed_channels(channels: Iterable[Channel]) -> list[Channel]:
    return [channel for channel in channels if channel.can_change]


def locked_channels(armature_object: bpy.types.Object, channels: tuple[Channel, ...]) -> tuple[Channel, ...]:
    """Return the locked or fixed rotation axes of the bones that channels rotate about other axes."""
    rotated_bones = {channel.name for channel in channels if channel.kind == ROTATION}
    sampled_axes = {(channel.name, channel.axis) for channel in channels if channel.kind == ROTATION}
    return tuple(
        Channel(bone.name, ROTATION, axis, 0.0, 0.0)
        for bone in armature_object.pose.bones
        if bone.name in rotated_bones
        for axis, rotation_range in enumerate(rotation_ranges(bone))
        if not rotation_range.moves and (bone.name, axis) not in sampled_axes
    )


def _rotation_channels(bone: bpy.types.PoseBone, ranges: dict[int, tuple[float, float]]) -> list[Channel]:
    return [Channel(bone.name, ROTATION, axis, *bounds) for axis, bounds in ranges.items()]


def _location_and_scale_channels(bone: bpy.types.PoseBone) -> list[Channel]:
    """Return the channels of the locations and scales for which a bone has a range."""
    locks = {LOCATION: bone.lock_location, SCALE: bone.lock_scale}
    return [
        Channel(bone.name, kind, axis, low, high)
        for (kind, axis), (low, high) in _location_and_scale_ranges(bone).items()
        if not locks[kind][axis] and low < high and not (kind == LOCATION and bone.bone.use_connect)
    ]


def _location_and_scale_ranges(bone: bpy.types.PoseBone) -> dict[tuple[str, int], tuple[float, float]]:
    """Return the ranges of locations and scales of a bone, by kind and axis."""
    kinds = ((LOCATION, location_ranges(bone)), (SCALE, scale_ranges(bone)))
    return {(kind, axis): bounds for kind, ranges in kinds for axis, bounds in ranges.items()}
