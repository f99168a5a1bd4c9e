# SPDX-License-Identifier: GPL-3.0-or-later
"""Scene state that is borrowed for a while and given back, whatever happens."""

from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager

import bpy

from .arrays import POSE_CHANNELS, read, write
from .compatibility import animation_curves, slot_of


@contextmanager
def temporary_pose(
    armature_object: bpy.types.Object, actions: Iterable[bpy.types.Action] = (), keep_animation: bool = False
) -> Iterator[None]:
    """Give back the pose of an armature, its animation and the current frame.

    Inside, the armature has no action and no NLA, so that poses stay as they are set.

    Args:
        armature_object: not in the NLA's tweak mode, where its action cannot be changed.
        actions: actions that will drive it; what else they animate, the object itself or a custom property, is given
            back as well.
        keep_animation: its own action and NLA drive it inside, as they do outside.
    """
    scene = bpy.context.scene
    bones = armature_object.pose.bones
    frame, subframe = scene.frame_current, scene.frame_subframe
    pose = {channel: read(bones, channel) for channel in POSE_CHANNELS}
    animation = armature_object.animation_data
    own = driving_actions(animation) if keep_animation and animation is not None else ()
    animated = animated_values(armature_object, [*actions, *own])
    if animation is not None:
        action, use_nla = animation.action, animation.use_nla
        slot = getattr(animation, "action_slot", None)
        if not keep_animation:
            animation.use_nla = False
            animation.action = None
    try:
        yield
    finally:
        if animation is None:
            if armature_object.animation_data is not None:
                armature_object.animation_data_clear()
        else:
            animation.action = action
            if action is not None and hasattr(animation, "action_slot"):
                # Also where it was none: Blender chooses one when an action is assigned.
                animation.action_slot = slot
            animation.use_nla = use_nla
        # The frame first: evaluating it sets animated channels, and the borrowed pose may differ from its keys.
        scene.frame_set(frame, subframe=subframe)
        for path, value in animated.items():
            set_value(armature_object, path, value)
        for channel, values in pose.items():
            write(bones, channel, values)
        armature_object.update_tag(refresh={"DATA"})
        bpy.context.view_layer.update()


def driving_actions(animation: bpy.types.AnimData) -> list[bpy.types.Action]:
    """The action of a datablock and those of its NLA strips."""
    strips = (strip for track in animation.nla_tracks for strip in track.strips)
    return [action for action in (animation.action, *(strip.action for strip in strips)) if action is not None]


def animated_paths(datablock: bpy.types.ID) -> set[str]:
    """RNA paths of all that the actions, the NLA and the drivers of a datablock set, also where they are muted."""
    animation = datablock.animation_data
    if animation is None:
        return set()
    curves = [curve for action in driving_actions(animation) for curve in animation_curves(action)]
    return {curve.data_path for curve in (*curves, *animation.drivers)}


def animated_values(owner: bpy.types.ID, actions: Iterable[bpy.types.Action]) -> dict[str, object]:
    """Values by RNA path of all that actions animate in a datablock."""
    values = {}
    for path in {curve.data_path for action in actions for curve in animation_curves(action)}:
        try:
            values[path] = read_value(owner, path)
        except ValueError:
            # A curve of something that is not there, or of another datablock's slot.
            continue
    return values


def read_value(owner: bpy.types.ID, path: str) -> object:
    """The number at an RNA path, or a copy of the numbers.

    Raises:
        ValueError: there is nothing at the path.
    """
    value = owner.path_resolve(path)
    return value[:] if hasattr(value, "__len__") else value


def set_value(owner: bpy.types.ID, path: str, value: object) -> None:
    """Set what `read_value` reads."""
    struct = owner.path_resolve(path, False).data
    if path.endswith('"]'):
        struct[bpy.utils.unescape_identifier(path[path.rindex('["') + 2 : -2])] = value
    else:
        setattr(struct, path.rpartition(".")[2], value)


@contextmanager
def temporary_attributes(owner: object, **values: object) -> Iterator[None]:
    """Set attributes of an RNA struct and give the old values back."""
    old = {name: getattr(owner, name) for name in values}
    try:
        for name, value in values.items():
            setattr(owner, name, value)
        yield
    finally:
        for name, value in old.items():
            setattr(owner, name, value)


@contextmanager
def temporary_visibility(objects: Iterable[bpy.types.Object]) -> Iterator[None]:
    """Show objects that animation hides in some frames: Blender evaluates no pose of what it does not show.

    What is hidden in all frames stays hidden, and is evaluated when something that shows needs it.
    """
    with ExitStack() as stack:
        for scene_object in (o for o in objects if o.animation_data is not None):
            animation = scene_object.animation_data
            curves = [curve for action in driving_actions(animation) for curve in animation_curves(action)]
            if hiding := [curve for curve in (*curves, *animation.drivers) if curve.data_path == "hide_viewport"]:
                for curve in hiding:
                    stack.enter_context(temporary_attributes(curve, mute=True))
                stack.enter_context(temporary_attributes(scene_object, hide_viewport=False))
        yield


def assign_action(datablock: bpy.types.ID, action: bpy.types.Action) -> None:
    """Let an action drive an armature, or another datablock, with the slot of `compatibility.slot_of`."""
    animation = datablock.animation_data or datablock.animation_data_create()
    animation.action = action
    slot = slot_of(action, datablock)
    if slot is not None and animation.action_slot != slot:
        animation.action_slot = slot
