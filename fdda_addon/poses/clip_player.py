# SPDX-License-Identifier: GPL-3.0-or-later
"""Shows the frames of clips: assigns an action to all datablocks of a rig, or enables their NLA, and restores them."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import bpy
import numpy as np

from ..core.recording.index import ACTION
from ..scene.animated_values import animated_values, driving_actions, read_value, set_value
from ..scene.armature import clear_pose
from ..scene.arrays import POSE_CHANNELS, read, write
from ..scene.compatibility import curves_of
from ..scene.controls import can_be_set, owner_of, set_control
from ..scene.scene_rig import SceneRig
from ..scene.temporary_state import assign_action
from .clip import Clip
from .mirror import Mirror

PropertyValues = dict[tuple[bpy.types.ID, str], object]
"""Values by datablock and RNA path."""

ControlledRigs = Sequence[tuple[SceneRig, Iterable[str]]]
"""Rigs of one armature, each with the names of controls that the caller sets between frames."""


@dataclass(frozen=True)
class ClipFrame:
    """The values that a clip sets in a frame.

    Attributes:
        channels: channels of the pose bones, an array for each of `POSE_CHANNELS`.
        numbers: values of other animated properties.
    """

    channels: tuple[np.ndarray, ...]
    numbers: PropertyValues


class ClipPlayer:
    """Shows frames of clips. Each frame looks the same, whatever frames were shown before.

    Bones that an action does not key are in the rest pose, and other numbers have their values in the file. An action
    also animates the shape keys, the mesh object and the armature's data if it has F-curves for them.
    """

    def __init__(self, rigs: ControlledRigs, clips: tuple[Clip, ...]):
        """Prepare to show clips.

        Args:
            rigs: the rigs.
            clips: the clips that will be shown.

        Raises:
            RigError: a clip is mirrored, and the rig is not symmetric.
        """
        self._armature_object, self._clip = rigs[0][0].armature_object, None
        self._other_datablocks = [d for d in _other_datablocks(rigs) if any(_animates(clip, d) for clip in clips)]
        self._idle_states: list[tuple] | None = None
        animated_numbers = {
            (datablock, path): value
            for datablock in (self._armature_object, *self._other_datablocks)
            for path, value in animated_values(datablock, _actions_of_clips(clips, datablock)).items()
            if not _is_pose_channel(path)
        }
        self._mirror = None
        if any(clip.is_mirrored for clip in clips):
            self._mirror = Mirror(self._armature_object, animated_numbers)
            animated_numbers |= {
                (datablock, path): datablock.path_resolve(path) for datablock, path in self._mirror.numbers
            }
        self._numbers: PropertyValues = animated_numbers
        self._controls: list[tuple[SceneRig, str, float]] = []
        for scene_rig, names in rigs:
            for name in filter(can_be_set, names):
                owner, _, path = name.partition("/")
                self._controls.append((scene_rig, name, owner_of(scene_rig, owner).path_resolve(path)))

    def show(self, clip: Clip, frame: int) -> None:
        """Show a frame of a clip. The armature must have no animation of its own (`temporary_pose`)."""
        if clip != self._clip:
            self._start(clip)
        elif clip.is_mirrored:
            self._reset_pose()
        bpy.context.scene.frame_set(frame)
        if clip.is_mirrored:
            self._mirror.apply()

    @property
    def current_clip_frame(self) -> ClipFrame:
        """Return the values of the frame that is shown."""
        bones = self._armature_object.pose.bones
        numbers = {(datablock, path): read_value(datablock, path) for datablock, path in self._numbers}
        return ClipFrame(tuple(read(bones, channel) for channel in POSE_CHANNELS), numbers)

    def set_clip_frame(self, clip_frame: ClipFrame, frame: int) -> None:
        """Set the values of a clip frame at any frame of the scene, without animation."""
        self.stop()
        for channel, values in zip(POSE_CHANNELS, clip_frame.channels, strict=True):
            write(self._armature_object.pose.bones, channel, values)
        for (datablock, path), value in clip_frame.numbers.items():
            set_value(datablock, path, value)
        for datablock in {self._armature_object, *(datablock for datablock, _ in clip_frame.numbers)}:
            datablock.update_tag()
        bpy.context.scene.frame_set(frame)

    def stop(self) -> None:
        """Remove the animation of the rig, and set the rest pose and the values that the numbers have in the file."""
        if self._clip is not None:
            self._clip = None
            animation = self._armature_object.animation_data
            if animation is not None:
                animation.use_nla, animation.action = False, None
            for datablock, state in zip(self._other_datablocks, self._idle_states, strict=True):
                _restore_animation(datablock, state)
            self._reset_pose()

    def _start(self, clip: Clip) -> None:
        self.stop()
        if self._idle_states is None:
            self._idle_states = [_animation_state(datablock) for datablock in self._other_datablocks]
        self._clip = clip
        self._reset_pose()
        for datablock in [d for d in (self._armature_object, *self._other_datablocks) if _animates(clip, d)]:
            if clip.kind == ACTION:
                assign_action(datablock, bpy.data.actions[clip.name])
            else:
                datablock.animation_data.action, datablock.animation_data.use_nla = None, True

    def _reset_pose(self) -> None:
        clear_pose(self._armature_object)
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
    """Yield a player of clips; afterwards restore the animation of the rigs and the numbers that the clips animate.

    Enter it before `temporary_pose`, which restores the animation of the armature object and the frame.

    Raises:
        RigError: as `ClipPlayer`.
    """
    player = ClipPlayer(rigs, clips)
    states = [(datablock, _animation_state(datablock)) for datablock in _other_datablocks(rigs)]
    try:
        yield player
    finally:
        for datablock, state in states:
            _restore_animation(datablock, state)
        # Evaluate the restored animation first, because the numbers may differ from its keyframes.
        bpy.context.view_layer.update()
        player.restore_numbers()
        bpy.context.view_layer.update()


def clip_actions(armature_object: bpy.types.Object, clips: tuple[Clip, ...]) -> list[bpy.types.Action]:
    """Return the actions that animate the armature object while clips are shown, for `temporary_pose`."""
    return _actions_of_clips(clips, armature_object)


def _other_datablocks(rigs: ControlledRigs) -> list[bpy.types.ID]:
    """Return the datablocks of rigs except the armature object, without duplicates."""
    meshes = [scene_rig.mesh_object for scene_rig, _ in rigs]
    datablocks = [rigs[0][0].armature_object.data]
    datablocks += [datablock for mesh_object in meshes for datablock in (mesh_object, mesh_object.data.shape_keys)]
    return list(dict.fromkeys(datablock for datablock in datablocks if datablock is not None))


def _actions_of_clips(clips: tuple[Clip, ...], datablock: bpy.types.ID) -> list[bpy.types.Action]:
    actions = [bpy.data.actions[clip.name] for clip in clips if clip.kind == ACTION]
    if datablock.animation_data is not None and any(clip.kind != ACTION for clip in clips):
        actions += driving_actions(datablock.animation_data)
    return actions


def _animates(clip: Clip, datablock: bpy.types.ID) -> bool:
    """Return whether a clip animates a datablock."""
    if clip.kind == ACTION:
        return bool(curves_of(bpy.data.actions[clip.name], datablock))
    return datablock.animation_data is not None and len(datablock.animation_data.nla_tracks) > 0


def _is_pose_channel(path: str) -> bool:
    """Return whether a path is a channel of a pose, which `clear_pose` resets."""
    return path.startswith("pose.bones[") and path.rpartition(".")[2] in {
        "location",
        "scale",
        "rotation_euler",
        "rotation_quaternion",
        "rotation_axis_angle",
    }


def _animation_state(datablock: bpy.types.ID) -> tuple | None:
    """Return action, slot and NLA state of a datablock; None without animation data."""
    animation = datablock.animation_data
    if animation is None:
        return None
    return animation.action, getattr(animation, "action_slot", None), animation.use_nla


def _restore_animation(datablock: bpy.types.ID, state: tuple | None) -> None:
    """Restore the state that `_animation_state` returned, if it has changed."""
    if state == _animation_state(datablock):
        return
    if state is None:
        datablock.animation_data_clear()
        return
    animation, (action, slot, use_nla) = datablock.animation_data, state
    animation.action = action
    if action is not None and hasattr(animation, "action_slot"):
        # Blender chooses a slot when an action is assigned, even if there was none before.
        animation.action_slot = slot
    animation.use_nla = use_nla
