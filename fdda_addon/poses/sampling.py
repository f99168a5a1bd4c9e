# SPDX-License-Identifier: GPL-3.0-or-later
"""What of a rig random poses move: bones in their ranges of motion, and controls."""

from collections.abc import Callable, Iterable
from dataclasses import replace

import bpy

from ..core.controls import Control
from ..core.errors import RigError
from ..core.model import ModelInfo
from ..core.poses import CONTROL, KINDS, LOCATION, RANGE_TOLERANCE, ROTATION, ROTATION_VECTOR, SCALE, Channel
from ..core.rig import Rig
from ..scene.controls import is_driven, is_number, owner_of
from ..scene.scene_rig import SceneRig
from .action_range import has_width
from .bone_channels import control_name, ranges_by_control
from .motion_range import DEFAULT, RotationRange, location_ranges, rotation_ranges, scale_ranges
from .sample_selection import DEFAULT_SELECTION, Measured, SampleSelection, select_bones

LIMITS = {"LIMIT_ROTATION", "LIMIT_LOCATION", "LIMIT_SCALE", "LIMIT_DISTANCE"}
Ranges = dict[str, tuple[float, float]]
"""Ranges by the names of controls."""


def choose(
    scene_rig: SceneRig, texts: Iterable[str], find_controls: Callable[[Ranges], Iterable[Control]]
) -> SampleSelection:
    """Read what a user chose.

    Args:
        scene_rig: the rig.
        texts: `selected` for the selected bones, `collection:NAME` for those of a bone collection and of the ones below
            it, `action:NAME` for what an action keys, `bone:NAME`; none for the bones of the rig as it stands.
        find_controls: returns the controls that are sampled too, from the ranges of the numbers of bones that are
            sampled (`ranges_by_control`): a control may be one of them.

    Raises:
        RigError: there is no such collection, action or bone, or it chooses nothing.
    """
    texts = list(texts)
    choice = select_bones(scene_rig, texts)
    controls = {control.name: control for control in choice.controls}
    controls |= {control.name: control for control in find_controls(sampled_numbers(scene_rig, choice))}
    choice = replace(choice, controls=tuple(controls.values()))
    moves = controls or choice.bones is None or choice.bones - choice.by_action
    if not moves and not any(has_width(bounds) for _, bounds in choice.measured):
        raise RigError(f"Nothing is chosen to sample by {', '.join(texts)}; choose bones that an animator poses.")
    return choice


def sampled_numbers(scene_rig: SceneRig, choice: SampleSelection) -> Ranges:
    """Ranges of the numbers of bones that a choice samples, where the rig or an action states them."""
    return ranges_by_control(scene_rig.armature_object, _bone_channels(scene_rig.armature_object, choice, set()))


def sampled_channels(scene_rig: SceneRig, rig: Rig, choice: SampleSelection = DEFAULT_SELECTION) -> tuple[Channel, ...]:
    """The channels of a random pose.

    Args:
        scene_rig, rig: the rig.
        choice: what the user chose.

    Raises:
        RigError: nothing may be sampled.
    """
    armature_object = scene_rig.armature_object
    controls = {control.name: (control.low, control.high) for control in choice.controls}
    found = []
    for channel in _bone_channels(armature_object, choice, set(rig.joint_names)):
        # A control that is a number of a bone is set with the bone, in the range of the control.
        bounds = controls.pop(control_name(armature_object, channel), (channel.low, channel.high))
        found.append(replace(channel, low=bounds[0], high=bounds[1]))
    found += [
        Channel(control.name, CONTROL, 0, control.low, control.high)
        for control in choice.controls
        if control.name in controls and not is_driven(owner_of(scene_rig, control.owner), control.path)
    ]
    listed = {control.name for control in choice.controls}
    found += [channel for channel in choice.held if channel.name not in listed]
    if not found:
        raise RigError(
            f"No bone of '{armature_object.name}' may be sampled: all {len(rig.joints)} are locked or moved by "
            "constraints; unlock an axis, give it a Limit Rotation, choose the bones that an animator poses "
            "(--sample), or record actions alone, with 0 random poses (--action NAME --poses 0)."
        )
    return tuple(found)


def _bone_channels(armature_object: bpy.types.Object, choice: SampleSelection, names: set[str]) -> tuple[Channel, ...]:
    """The channels of the bones that a choice samples; `names` as for `default_channels`."""
    if choice.bones is None:
        return default_channels(armature_object, names)
    return selected_channels(armature_object, choice)


def model_channels(scene_rig: SceneRig, rig: Rig, info: ModelInfo) -> tuple[Channel, ...]:
    """The channels that a model's random poses were drawn from; those of the rig where there were none.

    Raises:
        RigError: the rig lacks one of them, or nothing may be sampled.
    """
    bones = scene_rig.armature_object.pose.bones
    for channel in info.limits:
        owner, _, path = channel.name.partition("/")
        if channel.kind == CONTROL:
            there = is_number(owner_of(scene_rig, owner), path)
        else:
            there = channel.name in bones and channel.kind in KINDS
        if not there or channel.axis not in range(3):
            raise RigError(
                f"'{scene_rig.armature_object.name}' lacks '{channel.name}', which the random poses of the model "
                "moved; name it as before, or record and train this rig."
            )
    return info.limits or sampled_channels(scene_rig, rig)


def rig_states_channels(scene_rig: SceneRig, channels: tuple[Channel, ...]) -> bool:
    """Whether a rig still has the ranges that channels have, as far as it states them.

    A range of an action may be narrower than the limit of its bone.
    """
    bones = scene_rig.armature_object.pose.bones
    return all(_lets(bones[channel.name], channel) for channel in channels if channel.kind != CONTROL)


def _lets(bone: bpy.types.PoseBone, channel: Channel) -> bool:
    """Whether the limits and locks of a bone let a channel have its range."""
    rotations = rotation_ranges(bone)
    if channel.kind == ROTATION_VECTOR:
        return _are_free(rotations)
    if channel.kind == ROTATION:
        stated = rotations[channel.axis]
        if stated.is_locked:
            return False
        bounds = None if stated.source == DEFAULT else (stated.low, stated.high)
    else:
        locks = {LOCATION: bone.lock_location, SCALE: bone.lock_scale}[channel.kind]
        if locks[channel.axis]:
            return False
        bounds = _stated_bounds(bone).get((channel.kind, channel.axis))
    if bounds is None:
        return True
    return bounds[0] - RANGE_TOLERANCE <= channel.low and channel.high <= bounds[1] + RANGE_TOLERANCE


def _are_free(rotations: tuple[RotationRange, ...]) -> bool:
    """Whether no axis of a bone is locked or limited."""
    return all(stated.source == DEFAULT and not stated.is_locked for stated in rotations)


def default_channels(armature_object: bpy.types.Object, names: set[str]) -> tuple[Channel, ...]:
    """What of a pose may be sampled, and its range of motion.

    The range is that of Limit constraints in local space, for rotations else of the bone's IK limits, else the default;
    locked axes are left out. A bone that another constraint moves is left out: sampling it would change nothing.

    Args:
        armature_object: the armature object.
        names: bones that are sampled even when the rig states no range for them.
    """
    found = []
    for bone in armature_object.pose.bones:
        if is_moved_by_constraints(bone):
            continue
        ranges = rotation_ranges(bone)
        if bone.name in names or any(r.source != DEFAULT for r in ranges):
            found += _rotations(bone, {axis: (r.low, r.high) for axis, r in enumerate(ranges) if r.moves})
        found += _stated_others(bone)
    return tuple(found)


def selected_channels(armature_object: bpy.types.Object, choice: SampleSelection) -> tuple[Channel, ...]:
    """As `default_channels`, of the bones that a user chose, whatever constraints they have.

    Of the bones that are chosen by action only what the action keys is sampled, in the ranges of the action. Limits
    narrow these. What is keyed elsewhere than in the rest pose and stands still has a range of one value.
    """
    measured: dict[str, Measured] = {}
    for key, bounds in choice.measured:
        measured.setdefault(key[0], {})[key] = bounds
    found = []
    for bone in armature_object.pose.bones:
        if bone.name not in choice.bones:
            continue
        keyed, by_action = measured.get(bone.name, {}), bone.name in choice.by_action
        if not by_action:
            keyed = {key: bounds for key, bounds in keyed.items() if has_width(bounds)}
        found += (*_chosen_rotations(bone, keyed, by_action), *_chosen_others(bone, keyed, by_action))
    return tuple(found)


def _chosen_rotations(bone: bpy.types.PoseBone, keyed: Measured, by_action: bool) -> list[Channel]:
    stated = rotation_ranges(bone)
    vectors = {key[2]: bounds for key, bounds in keyed.items() if key[1] == ROTATION_VECTOR}
    if vectors and _are_free(stated):
        return _changing(Channel(bone.name, ROTATION_VECTOR, axis, *bounds) for axis, bounds in vectors.items())
    ranges: dict[int, tuple[float, float]] = {}
    for axis, limit in enumerate(stated):
        own = keyed.get((bone.name, ROTATION, axis))
        if limit.is_locked:
            continue
        if own and limit.source == DEFAULT:
            ranges[axis] = own
        elif own and by_action:
            ranges[axis] = _narrowed(own, (limit.low, limit.high))
        elif limit.moves and not by_action:
            ranges[axis] = (limit.low, limit.high)
    return _changing(_rotations(bone, ranges))


def _chosen_others(bone: bpy.types.PoseBone, keyed: Measured, by_action: bool) -> list[Channel]:
    """Channels of locations and scales."""
    stated = {} if by_action else {(c.kind, c.axis): c for c in _stated_others(bone)}
    limits, locks = _stated_bounds(bone), {LOCATION: bone.lock_location, SCALE: bone.lock_scale}
    for (name, kind, axis), bounds in keyed.items():
        # A connected bone stays where its parent ends.
        if kind in locks and not locks[kind][axis] and not (kind == LOCATION and bone.bone.use_connect):
            own = _narrowed(bounds, limits[kind, axis]) if (kind, axis) in limits else bounds
            stated.setdefault((kind, axis), Channel(name, kind, axis, *own))
    return _changing(stated.values())


def _narrowed(bounds: tuple[float, float], limit: tuple[float, float]) -> tuple[float, float]:
    """What a limit leaves of a range; its nearest end where it leaves nothing."""
    return tuple(min(max(end, limit[0]), limit[1]) for end in bounds)


def _changing(channels: Iterable[Channel]) -> list[Channel]:
    return [channel for channel in channels if channel.can_change]


def locked_channels(armature_object: bpy.types.Object, channels: tuple[Channel, ...]) -> tuple[Channel, ...]:
    """The locked axes of the bones that channels turn, and those whose range is empty, in the order of the bones."""
    turned = {channel.name for channel in channels if channel.kind == ROTATION}
    sampled = {(channel.name, channel.axis) for channel in channels if channel.kind == ROTATION}
    return tuple(
        Channel(bone.name, ROTATION, axis, 0.0, 0.0)
        for bone in armature_object.pose.bones
        if bone.name in turned
        for axis, stated in enumerate(rotation_ranges(bone))
        if not stated.moves and (bone.name, axis) not in sampled
    )


def _rotations(bone: bpy.types.PoseBone, ranges: dict[int, tuple[float, float]]) -> list[Channel]:
    return [Channel(bone.name, ROTATION, axis, *bounds) for axis, bounds in ranges.items()]


def _stated_others(bone: bpy.types.PoseBone) -> list[Channel]:
    """Channels of the locations and scales that a bone states a range of."""
    locks = {LOCATION: bone.lock_location, SCALE: bone.lock_scale}
    return [
        Channel(bone.name, kind, axis, low, high)
        for (kind, axis), (low, high) in _stated_bounds(bone).items()
        if not locks[kind][axis] and low < high and not (kind == LOCATION and bone.bone.use_connect)
    ]


def _stated_bounds(bone: bpy.types.PoseBone) -> dict[tuple[str, int], tuple[float, float]]:
    """Ranges of locations and scales that a bone states, by kind and axis."""
    kinds = ((LOCATION, location_ranges(bone)), (SCALE, scale_ranges(bone)))
    return {(kind, axis): bounds for kind, ranges in kinds for axis, bounds in ranges.items()}


def is_moved_by_constraints(bone: bpy.types.PoseBone) -> bool:
    """Whether a constraint other than a limit moves a bone."""
    return any(c.type not in LIMITS and not c.mute and c.influence > 0 for c in bone.constraints)
