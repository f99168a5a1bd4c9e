# SPDX-License-Identifier: GPL-3.0-or-later
"""Changes the state of a scene temporarily: context managers that restore it, also after an exception."""

from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager

import bpy

from .animated_values import animated_values, driving_actions, read_scene_values, restore_values, set_value
from .arrays import POSE_CHANNELS, read, write
from .compatibility import animation_curves
from .unkeyed_changes import discard_requests, keep_unkeyed_changes


@contextmanager
def temporary_pose(armature_object: bpy.types.Object, actions: Iterable[bpy.types.Action] = ()) -> Iterator[None]:
    """Remove the animation of an armature, so that poses can be set; restore it, the pose and the frame afterwards.

    Args:
        armature_object: the armature object, not in the NLA's tweak mode, in which its action cannot be changed.
        actions: actions that will be assigned to the armature object. All other properties that they animate are
            restored too, such as transforms of the object and custom properties.

    Unkeyed changes of the scene's other objects are restored too, because setting the frame resets them.
    """
    discard_requests()
    scene = bpy.context.scene
    bones = armature_object.pose.bones
    frame, subframe = scene.frame_current, scene.frame_subframe
    pose_values = {channel: read(bones, channel) for channel in POSE_CHANNELS}
    scene_values = read_scene_values(scene)
    animation = armature_object.animation_data
    animated_before = animated_values(armature_object, actions)
    state = animation_state(armature_object)
    if animation is not None:
        animation.use_nla, animation.action = False, None
    try:
        yield
    finally:
        restore_animation(armature_object, state)
        # Set the frame first: it sets animated channels, and the restored pose may differ from the keyframes.
        scene.frame_set(frame, subframe=subframe)
        restore_values(scene_values)
        for path, value in animated_before.items():
            set_value(armature_object, path, value)
        for channel, values in pose_values.items():
            write(bones, channel, values)
        armature_object.update_tag(refresh={"DATA"})
        bpy.context.view_layer.update()
        keep_unkeyed_changes()


def animated_paths(datablock: bpy.types.ID) -> set[str]:
    """Return the RNA paths that the actions, the NLA and the drivers of a datablock set, including muted ones."""
    animation = datablock.animation_data
    if animation is None:
        return set()
    curves = [curve for action in driving_actions(animation) for curve in animation_curves(action)]
    return {curve.data_path for curve in (*curves, *animation.drivers)}


@contextmanager
def temporary_attributes(owner: object, **values: object) -> Iterator[None]:
    """Set attributes of an RNA struct, and restore the previous values afterwards."""
    previous_values = {name: getattr(owner, name) for name in values}
    try:
        for name, value in values.items():
            setattr(owner, name, value)
        yield
    finally:
        for name, value in previous_values.items():
            setattr(owner, name, value)


@contextmanager
def deformation_disabled(mesh_object: bpy.types.Object, modifiers: Iterable[bpy.types.Modifier]) -> Iterator[None]:
    """Disable modifiers and all shape keys of a mesh object in the block."""
    with ExitStack() as stack:
        for modifier in modifiers:
            stack.enter_context(temporary_attributes(modifier, show_viewport=False))
        if mesh_object.data.shape_keys is not None:
            # Blender copies a pinned shape key instead of mixing all shape keys.
            stack.enter_context(temporary_attributes(mesh_object, show_only_shape_key=True, active_shape_key_index=0))
        yield


@contextmanager
def temporary_visibility(
    objects: Iterable[bpy.types.Object], paths: Iterable[str] = ("hide_viewport",)
) -> Iterator[None]:
    """Show objects that animation hides in some frames: Blender does not evaluate the pose of a hidden object.

    Objects that are hidden in all frames stay hidden; Blender evaluates them if a visible object needs them.
    """
    with ExitStack() as stack:
        for scene_object in (o for o in objects if o.animation_data is not None):
            animation = scene_object.animation_data
            curves = [curve for action in driving_actions(animation) for curve in animation_curves(action)]
            for path in paths:
                hiding_curves = [curve for curve in (*curves, *animation.drivers) if curve.data_path == path]
                for curve in hiding_curves:
                    stack.enter_context(temporary_attributes(curve, mute=True))
                if hiding_curves:
                    stack.enter_context(temporary_attributes(scene_object, **{path: False}))
        yield


def assign_action(
    datablock: bpy.types.ID, action: bpy.types.Action | None, slot: "bpy.types.ActionSlot | None"
) -> None:
    """Assign an action and one of its slots to a datablock."""
    animation = datablock.animation_data or datablock.animation_data_create()
    animation.action = action
    if action is not None:
        # Blender chooses a slot when an action is assigned.
        animation.action_slot = slot


AnimationState = tuple[bpy.types.Action | None, "bpy.types.ActionSlot | None", bool] | None
"""Action, slot, and whether the NLA is on; None without animation data."""


def animation_state(datablock: bpy.types.ID) -> AnimationState:
    """Return the state of a datablock's animation, for `restore_animation`."""
    animation = datablock.animation_data
    return None if animation is None else (animation.action, animation.action_slot, animation.use_nla)


def restore_animation(datablock: bpy.types.ID, state: AnimationState) -> None:
    """Restore the state that `animation_state` returned, if it has changed."""
    if state == animation_state(datablock):
        return
    if state is None:
        datablock.animation_data_clear()
        return
    action, slot, use_nla = state
    assign_action(datablock, action, slot)
    datablock.animation_data.use_nla = use_nla
