# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads the frames of actions from which random poses combine limbs (`core.mathematics.remix`)."""

from collections.abc import Iterable, Sequence
from contextlib import suppress

import bpy
import numpy as np
from mathutils import Euler

from ..core.errors import RigError
from ..core.mathematics.poses import CONTROL, LOCATION, RANGE_TOLERANCE, ROTATION_VECTOR, SCALE, Channel
from ..core.mathematics.remix import Remix, find_limbs
from ..core.mathematics.rotations import rotation_vectors
from ..core.wording import format_count
from ..scene.action_slots import (
    constraint_actions,
    curves_of_actions,
    dependencies,
    slots_of_action,
    unmuted_curves,
)
from ..scene.controls import is_driven, is_number, owner_of
from ..scene.scene_rig import SceneRig
from .action_range import (
    CurvesByChannel,
    action_frames,
    axis_angle_to_quaternion,
    computed_for_actions,
    curves_by_bone,
    evaluate_curves,
    has_width,
    keyed_numbers,
    measured_ranges,
)
from .clip_player import flipped_name, flipped_path
from .motion_range import limited_bones

REMIX = "remix"
"""Entry for the bones of actions whose limbs are combined from different frames (`mathematics.remix`)."""
MAX_FRAMES = 3000
"""Largest number of frames of actions that are read without being recorded."""
_REFLECTION = np.diag([-1.0, 1.0, 1.0])
HEAD_TOLERANCE = 0.01
"""Largest distance between the head of a bone and its mirror image, relative to the size of the armature."""
_REST_VALUES = {ROTATION_VECTOR: 0.0, LOCATION: 0.0, SCALE: 1.0}


def choose_bones(scene_rig: SceneRig, recorded_actions: Sequence[bpy.types.Action]) -> tuple[str, ...]:
    """Choose what random poses move if the user does not.

    Limbs come from the recorded actions. Without any, the deforming bones and all bones with limits move. If no bone
    has limits, limbs come from all actions of the rig, because any other range would be a guess.

    Returns:
        The choice in the syntax of `sampling.parse_sample_selection`.
    """
    if not recorded_actions and limited_bones(scene_rig.armature_object):
        return ()
    actions = remixed_actions(scene_rig, recorded_actions)
    return (REMIX,) if measured_ranges(scene_rig.armature_object, actions) else ()


def describe_bones(
    scene_rig: SceneRig, bones_to_pose: tuple[str, ...], recorded_actions: Sequence[bpy.types.Action]
) -> str:
    """Return a sentence about what random poses move; `bones_to_pose` is a result of `choose_bones`."""
    if not bones_to_pose:
        return "Random poses move the deforming bones and all bones with limits."
    count = len(remixed_actions(scene_rig, recorded_actions))
    if recorded_actions:
        return f"Random poses combine limbs from {format_count(count, 'recorded action')}."
    not_recorded = "which is not recorded itself" if count == 1 else "which are not recorded themselves"
    return f"Random poses combine limbs from {format_count(count, 'action')}, {not_recorded}."


def remixed_actions(scene_rig: SceneRig, recorded_actions: Sequence[bpy.types.Action]) -> tuple[bpy.types.Action, ...]:
    """Return the actions whose limbs are combined: the recorded ones, or without any, all that key bones of a rig.

    All actions are those with `MAX_FRAMES` frames together at most, in the order of their names.
    """
    if recorded_actions:
        return tuple(recorded_actions)
    armature_object, actions, frames = scene_rig.armature_object, [], 0
    datablocks = dependencies(*scene_rig.mesh_objects, armature_object)
    excluded = constraint_actions(armature_object)
    for action in bpy.data.actions:
        # An action that fits two objects equally is one of another rig.
        with suppress(RigError):
            slot = None if action in excluded else slots_of_action(action, datablocks).get(armature_object)
            users = slot.users() if slot else ()
            # Another character whose bones have the same names may play it.
            if slot is None or (users and not set(users) & set(datablocks)):
                continue
            curves = unmuted_curves(action, slot)
            if any(curves_by_bone(armature_object, {armature_object: [curve]}) for curve in curves):
                frames += len(action_frames(action))
                actions += [action] if frames <= MAX_FRAMES or not actions else []
    return tuple(actions)


def read_remix(scene_rig: SceneRig, recorded_actions: Sequence[bpy.types.Action]) -> Remix:
    """Read the frames of the actions whose limbs are combined (`remixed_actions`).

    Where the bones have two sides, the mirror images of all frames follow the frames: what one leg does, the other may
    do. A bone that an action does not key is in its rest pose in the frames of this action. Locations, scales and
    custom properties of a bone come from the same frame as its rotation, without noise; numbers that belong to no
    bone, such as shape keys, all come from another frame.

    Raises:
        RigError: the actions move no bone, or have one pose.
    """
    actions = remixed_actions(scene_rig, recorded_actions)
    datablocks = scene_rig.armature_object, *scene_rig.mesh_objects
    return computed_for_actions("remix", datablocks, actions, lambda: _read_remix(scene_rig, actions))


def _read_remix(scene_rig: SceneRig, actions: Sequence[bpy.types.Action]) -> Remix:
    armature_object = scene_rig.armature_object
    curves_by_action = curves_of_actions(actions, *scene_rig.mesh_objects, armature_object)
    clips = [
        (action_frames(action), curves_by_bone(armature_object, curves))
        for action, curves in zip(actions, curves_by_action, strict=True)
    ]
    keyed_names = {name for _, curves in clips for name in curves}
    bones = [bone for bone in armature_object.pose.bones if bone.name in keyed_names]
    mirror, channels_by_bone = _mirror_images(bones), {bone.name: _read_channels(bone, clips) for bone in bones}
    limbs = dict(zip((bone.name for bone in bones), find_limbs(_parents(bones)).tolist(), strict=True))
    columns: list[tuple[Channel, np.ndarray, int, bool]] = []
    for bone in bones:
        for kind, values in _bone_values(bone, channels_by_bone, mirror).items():
            is_used = np.abs(values - _REST_VALUES[kind]).max(axis=0) > RANGE_TOLERANCE
            for axis in range(3):
                if is_used[axis] or (kind == ROTATION_VECTOR and is_used.any()):
                    channel = Channel(bone.name, kind, axis, *_bounds(values[:, axis]))
                    has_noise = kind == ROTATION_VECTOR and not bone.lock_rotation[axis]
                    columns.append((channel, values[:, axis], limbs[bone.name], has_noise))
    names = ", ".join(f"'{action.name}'" for action in actions)
    if not columns:
        moves = f"{names} moves no bone" if names else "no action moves a bone"
        raise RigError(f"There is no pose to remix: {moves} of '{armature_object.name}'.")
    bones_by_path = {bone.path_from_id(): bone for bone in bones}
    numbers = _number_values(scene_rig, actions)
    for (owner, path), values in numbers.items():
        bone_path = path[: path.find('"]') + 2]
        bone = bones_by_path.get(bone_path)
        if mirror:
            image_path = flipped_path(path) if bone is None else path
            if bone is not None and bone.name in mirror:
                image_path = mirror[bone.name].path_from_id() + flipped_path(path.removeprefix(bone_path))
            values = np.concatenate([values, numbers.get((owner, image_path), values)])
        limb = len(bones) if bone is None else limbs[bone.name]
        columns.append((Channel(f"{owner}/{path}", CONTROL, 0, *_bounds(values)), values, limb, False))
    if not any(has_width(_bounds(values)) for _, values, _, _ in columns):
        raise RigError(
            f"There is only one pose to remix: nothing of '{armature_object.name}' moves in {names}; record "
            "other actions."
        )
    channels, values, channel_limbs, has_noise = zip(*columns, strict=True)
    return Remix(channels, np.stack(values, axis=1), np.array(channel_limbs, np.int64), np.array(has_noise, bool))


def _parents(bones: Sequence[bpy.types.PoseBone]) -> list[int]:
    """Return the index of the nearest ancestor of each bone among the bones, -1 without one."""
    indices = {bone.name: index for index, bone in enumerate(bones)}
    return [
        next((indices[ancestor.name] for ancestor in bone.parent_recursive if ancestor.name in indices), -1)
        for bone in bones
    ]


def _bounds(values: np.ndarray) -> tuple[float, float]:
    return float(values.min()), float(values.max())


def _mirror_images(bones: Sequence[bpy.types.PoseBone]) -> dict[str, bpy.types.PoseBone]:
    """Return the bone on the other side of keyed bones; a bone in the middle is its own mirror image.

    Names tell the sides. Bones are left out whose head in the rest pose is not the mirror image of the other's about
    the YZ plane of the armature. Empty if no bone has another side.
    """
    if not bones:
        return {}
    by_name = {bone.name: bone for bone in bones}
    partners = [by_name.get(flipped_name(bone.name), bone) for bone in bones]
    heads = np.array([bone.bone.head_local for bone in bones])
    image_heads = np.array([partner.bone.head_local for partner in partners]) @ _REFLECTION
    is_image = np.linalg.norm(heads - image_heads, axis=1) <= HEAD_TOLERANCE * np.ptp(heads, axis=0).max()
    images = {bone.name: partner for bone, partner, fits in zip(bones, partners, is_image, strict=True) if fits}
    return images if any(image.name != name for name, image in images.items()) else {}


def _bone_values(
    bone: bpy.types.PoseBone,
    channels_by_bone: dict[str, tuple[np.ndarray, ...]],
    mirror: dict[str, bpy.types.PoseBone],
) -> dict[str, np.ndarray]:
    """Return (F, 3) values of a bone in all frames, by kind.

    Args:
        channels_by_bone: the arrays of `_read_channels` of each keyed bone.
        mirror: mirror images of the bones (`_mirror_images`). Unless it is empty, the frames of the bone's image
            follow, or those of the bone again, (2 F, 3).
    """
    channels = [channels_by_bone[bone.name]]
    if image := mirror.get(bone.name):
        channels.append(_mirrored_channels(bone, image, *channels_by_bone[image.name]))
    elif mirror:
        channels *= 2
    quaternions, locations, scales = (np.concatenate(values) for values in zip(*channels, strict=True))
    return {ROTATION_VECTOR: rotation_vectors(quaternions), LOCATION: locations, SCALE: scales}


def _mirrored_channels(
    bone: bpy.types.PoseBone,
    image: bpy.types.PoseBone,
    quaternions: np.ndarray,
    locations: np.ndarray,
    scales: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """Mirror (F, 4) quaternions, (F, 3) locations and scales of a bone's image: what the bone does in the mirror."""
    axes, image_axes = (np.array(each.bone.matrix_local.to_3x3()) for each in (bone, image))
    turn = image_axes.T @ _REFLECTION @ axes
    # Without Local Location, a location is in the space of the armature.
    space, image_space = (
        each_axes if each.bone.use_local_location else np.eye(3)
        for each, each_axes in ((bone, axes), (image, image_axes))
    )
    # A reflection turns the axis of a rotation, and reverses its direction.
    quaternions = np.column_stack([quaternions[:, 0], -quaternions[:, 1:] @ turn])
    return quaternions, locations @ image_space.T @ _REFLECTION @ space, scales @ turn**2


def _read_channels(
    bone: bpy.types.PoseBone, clips: Iterable[tuple[range, dict[str, CurvesByChannel]]]
) -> tuple[np.ndarray, ...]:
    """Return (F, 4) quaternions, (F, 3) locations and scales of a bone in all frames of clips with their F-curves."""
    quaternions, locations, scales = [], [], []
    for frames, curves_of_bones in clips:
        curves = curves_of_bones.get(bone.name, {})
        quaternions.append(_quaternions(bone, curves, frames))
        locations.append(evaluate_curves(curves.get(LOCATION, {}), LOCATION, frames))
        scales.append(evaluate_curves(curves.get(SCALE, {}), SCALE, frames))
    return np.concatenate(quaternions), np.concatenate(locations), np.concatenate(scales)


def _quaternions(bone: bpy.types.PoseBone, curves: CurvesByChannel, frames: range) -> np.ndarray:
    """Return the (F, 4) rotations of a bone relative to its rest pose, in its rotation mode."""
    if bone.rotation_mode == "QUATERNION":
        return evaluate_curves(curves.get("rotation_quaternion", {}), "rotation_quaternion", frames)
    if bone.rotation_mode == "AXIS_ANGLE":
        values = evaluate_curves(curves.get("rotation_axis_angle", {}), "rotation_axis_angle", frames)
        return np.array([axis_angle_to_quaternion(value) for value in values])
    angles = evaluate_curves(curves.get("rotation_euler", {}), "rotation_euler", frames)
    return np.array([Euler(angle, bone.rotation_mode).to_quaternion() for angle in angles])


def _number_values(scene_rig: SceneRig, actions: Sequence[bpy.types.Action]) -> dict[tuple[str, str], np.ndarray]:
    """Return (F,) values of the numbers that actions key, by owner and path.

    A number has its current value in the frames of an action that does not key it.
    """
    numbers_by_action = keyed_numbers(scene_rig, actions)
    values: dict[tuple[str, str], np.ndarray] = {}
    for owner, path in dict.fromkeys(key for numbers in numbers_by_action for key in numbers):
        datablock = owner_of(scene_rig, owner)
        if is_number(datablock, path) and not is_driven(datablock, path):
            current = float(datablock.path_resolve(path))
            values[owner, path] = np.concatenate(
                [
                    numbers.get((owner, path), np.full(len(action_frames(action)), current))
                    for action, numbers in zip(actions, numbers_by_action, strict=True)
                ]
            )
    return values
