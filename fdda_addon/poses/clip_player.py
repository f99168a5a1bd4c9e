# SPDX-License-Identifier: GPL-3.0-or-later
"""Shows the frames of clips: assigns an action to the datablocks that it animates, or enables their NLA."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

import bpy
import numpy as np

from ..core.recording.index import ACTION
from ..scene.action_slots import dependencies, slots_of_action
from ..scene.animated_values import animated_values, driving_actions, read_value, set_value
from ..scene.armature import clear_pose
from ..scene.arrays import POSE_CHANNELS, read, write
from ..scene.controls import can_be_set, owner_of, set_control
from ..scene.scene_rig import SceneRig
from ..scene.temporary_state import (
    AnimationState,
    animation_state,
    assign_action,
    restore_animation,
    temporary_pose,
)
from .clip import Clip

PropertyValues = dict[tuple[bpy.types.ID, str], object]
"""Values by datablock and RNA path."""

ControlledRigs = Sequence[tuple[SceneRig, Iterable[str]]]
"""Rigs of one armature, each with the names of controls that the caller sets between frames."""


@dataclass(frozen=True)
class ClipFrame:
    """The values that a clip sets in a frame.

    Attributes:
        channels: channels of the pose bones by armature object, an array for each of `POSE_CHANNELS`.
        numbers: values of other animated properties.
    """

    channels: dict[bpy.types.Object, tuple[np.ndarray, ...]]
    numbers: PropertyValues


class ClipPlayer:
    """Shows frames of clips. Each frame looks the same, whatever frames were shown before.

    A clip animates all datablocks on which the rigs depend and for which it has F-curves (`slots_of_action`).
    Examples are shape keys, and another armature with the control rig. Bones that an action does not key are in the
    rest pose, and other numbers have their values in the file.

    Attributes:
        armature_objects: the armature object of the rigs, then others that a clip animates.
        other_datablocks: further datablocks that a clip animates.
    """

    def __init__(self, rigs: ControlledRigs, clips: tuple[Clip, ...]):
        """Prepare to show clips.

        Args:
            clips: the clips that will be shown.
        """
        armature_object, self._clip = rigs[0][0].armature_object, None
        mesh_objects = [mesh_object for scene_rig, _ in rigs for mesh_object in scene_rig.mesh_objects]
        datablocks = dependencies(armature_object, *mesh_objects) if clips else []
        self._slots = {clip: _animated_datablocks(clip, datablocks) for clip in clips}
        animated_datablocks = dict.fromkeys(datablock for slots in self._slots.values() for datablock in slots)
        is_armature = {d: getattr(d, "type", "") == "ARMATURE" for d in animated_datablocks}
        self.armature_objects = list(dict.fromkeys([armature_object, *filter(is_armature.get, animated_datablocks)]))
        self.other_datablocks = [d for d in animated_datablocks if not is_armature[d]]
        self._idle_states: list[AnimationState] | None = None
        channels = {channel.name for channel in POSE_CHANNELS}
        animated_numbers = {
            (datablock, path): value
            for datablock in (*self.armature_objects, *self.other_datablocks)
            for path, value in animated_values(datablock, actions_of_clips(clips, datablock)).items()
            # `clear_pose` resets the channels of a pose.
            if not (path.startswith("pose.bones[") and path.rpartition(".")[2] in channels)
        }
        self._numbers: PropertyValues = animated_numbers
        self._controls: list[tuple[SceneRig, str, float]] = []
        for scene_rig, names in rigs:
            for name in filter(can_be_set, names):
                owner, _, path = name.partition("/")
                self._controls.append((scene_rig, name, owner_of(scene_rig, owner).path_resolve(path)))

    def show(self, clip: Clip, frame: int) -> None:
        """Show a frame of a clip."""
        if clip != self._clip:
            self.start(clip)
        bpy.context.scene.frame_set(frame)

    @property
    def current_clip_frame(self) -> ClipFrame:
        """Return the values of the frame that is shown."""
        channels = {a: tuple(read(a.pose.bones, channel) for channel in POSE_CHANNELS) for a in self.armature_objects}
        numbers = {(datablock, path): read_value(datablock, path) for datablock, path in self._numbers}
        return ClipFrame(channels, numbers)

    def set_clip_frame(self, clip_frame: ClipFrame, frame: int) -> None:
        """Set the values of a clip frame at any frame of the scene, without animation."""
        self.stop()
        for armature_object, channel_values in clip_frame.channels.items():
            for channel, values in zip(POSE_CHANNELS, channel_values, strict=True):
                write(armature_object.pose.bones, channel, values)
        for (datablock, path), value in clip_frame.numbers.items():
            set_value(datablock, path, value)
        for datablock in {*self.armature_objects, *(datablock for datablock, _ in clip_frame.numbers)}:
            datablock.update_tag()
        bpy.context.scene.frame_set(frame)

    def stop(self) -> None:
        """Remove the animation of the rig, and set the rest pose and the values that the numbers have in the file."""
        if self._clip is not None:
            self._clip = None
            for armature_object in self.armature_objects:
                if (animation := armature_object.animation_data) is not None:
                    animation.use_nla, animation.action = False, None
            for datablock, state in zip(self.other_datablocks, self._idle_states, strict=True):
                restore_animation(datablock, state)
            self.reset_pose()

    def start(self, clip: Clip) -> None:
        """Let a clip animate the rigs, from the rest pose, at any frame that the caller sets."""
        self.stop()
        if self._idle_states is None:
            self._idle_states = [animation_state(datablock) for datablock in self.other_datablocks]
        self._clip = clip
        self.reset_pose()
        for datablock, slot in self._slots[clip].items():
            if clip.kind == ACTION:
                assign_action(datablock, bpy.data.actions[clip.name], slot)
            else:
                datablock.animation_data.action, datablock.animation_data.use_nla = None, True

    def reset_pose(self) -> None:
        """Set the rest pose, and the numbers to their values in the file."""
        for armature_object in self.armature_objects:
            clear_pose(armature_object)
        self.restore_numbers()

    def restore_numbers(self) -> None:
        """Set the numbers to their values in the file."""
        for (datablock, path), value in self._numbers.items():
            set_value(datablock, path, value)
        for scene_rig, name, value in self._controls:
            set_control(scene_rig, name, value)
        for datablock in {datablock for datablock, _ in self._numbers}:
            datablock.update_tag()


@contextmanager
def clip_player(rigs: ControlledRigs, clips: tuple[Clip, ...]) -> Iterator[ClipPlayer]:
    """Yield a player of clips, with the armatures that it animates in the rest pose and without animation.

    Afterwards restore poses, animation, the numbers that the clips animate, and the frame.
    """
    player = ClipPlayer(rigs, clips)
    states = [(datablock, animation_state(datablock)) for datablock in player.other_datablocks]
    try:
        with ExitStack() as stack:
            for armature_object in player.armature_objects:
                stack.enter_context(temporary_pose(armature_object, actions_of_clips(clips, armature_object)))
                clear_pose(armature_object)
            yield player
    finally:
        for datablock, state in states:
            restore_animation(datablock, state)
        # Evaluate the restored animation first, because the numbers may differ from its keyframes.
        bpy.context.view_layer.update()
        player.restore_numbers()
        bpy.context.view_layer.update()


def actions_of_clips(clips: tuple[Clip, ...], datablock: bpy.types.ID) -> list[bpy.types.Action]:
    """Return the actions that may animate a datablock while clips are shown."""
    actions = [bpy.data.actions[clip.name] for clip in clips if clip.kind == ACTION]
    if datablock.animation_data is not None and any(clip.kind != ACTION for clip in clips):
        actions += driving_actions(datablock.animation_data)
    return actions


def _animated_datablocks(
    clip: Clip, datablocks: Sequence[bpy.types.ID]
) -> "dict[bpy.types.ID, bpy.types.ActionSlot | None]":
    """Return the datablocks that a clip animates, each with the slot of the action; None for strips."""
    if clip.kind == ACTION:
        return slots_of_action(bpy.data.actions[clip.name], datablocks)
    animations = [(datablock, getattr(datablock, "animation_data", None)) for datablock in datablocks]
    return {datablock: None for datablock, animation in animations if animation and len(animation.nla_tracks)}
