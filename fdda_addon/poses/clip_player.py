# SPDX-License-Identifier: GPL-3.0-or-later
"""Shows the frames of clips: lets an action or the NLA drive all datablocks of a rig, and gives everything back."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import bpy
import numpy as np

from ..core.recording.index import ACTION
from ..scene.armature import clear_pose
from ..scene.arrays import POSE_CHANNELS, read, write
from ..scene.compatibility import curves_of
from ..scene.controls import owner_of, set_control
from ..scene.scene_rig import SceneRig
from ..scene.temporary_state import animated_values, assign_action, driving_actions, read_value, set_value
from .clip import Clip
from .mirror import Mirror

Numbers = dict[tuple[bpy.types.ID, str], object]
"""Values by datablock and RNA path."""

Controlled = Sequence[tuple[SceneRig, Iterable[str]]]
"""Rigs of one armature, each with the names of the controls that something else sets between frames."""


@dataclass(frozen=True)
class Shown:
    """What a clip set in a frame.

    Attributes:
        channels: of the pose bones, an array for each of `POSE_CHANNELS`.
        numbers: what else it animates.
    """

    channels: tuple[np.ndarray, ...]
    numbers: Numbers


class ClipPlayer:
    """Shows frames of clips; each depends on its clip and number alone, not on what was shown before.

    What an action does not key is at rest, and numbers that it does not key are as in the file. An action drives the
    shape keys, the mesh object and the armature's data as well, where it has F-curves for them.
    """

    def __init__(self, rigs: Controlled, clips: tuple[Clip, ...]):
        """Args:
            rigs: the rigs.
            clips: that will be shown.

        Raises:
            RigError: a clip is to be mirrored, and the rig is not the same on both sides.
        """
        self._armature_object, self._clip = rigs[0][0].armature_object, None
        self._others = [d for d in _others(rigs) if any(_drives(clip, d) for clip in clips)]
        self._idle: list[tuple] | None = None
        animated = {
            (datablock, path): value
            for datablock in (self._armature_object, *self._others)
            for path, value in animated_values(datablock, _actions(clips, datablock)).items()
            if not _is_channel(path)
        }
        self._mirror = None
        if any(clip.is_mirrored for clip in clips):
            self._mirror = Mirror(self._armature_object, animated)
            animated |= {(datablock, path): datablock.path_resolve(path) for datablock, path in self._mirror.numbers}
        self._numbers: Numbers = animated
        self._controls: list[tuple[SceneRig, str, float]] = []
        for scene_rig, names in rigs:
            for name in names:
                owner, _, path = name.partition("/")
                self._controls.append((scene_rig, name, owner_of(scene_rig, owner).path_resolve(path)))

    def show(self, clip: Clip, frame: int) -> None:
        """Go to a frame of a clip. The armature has no animation of its own meanwhile (`temporary_pose`)."""
        if clip != self._clip:
            self._start(clip)
        elif clip.is_mirrored:
            self._reset()
        bpy.context.scene.frame_set(frame)
        if clip.is_mirrored:
            self._mirror.apply()

    def frames(self, clip: Clip, first: int = 0) -> Iterator[None]:
        """Show the frames of a clip, one an iteration, from the one of number `first` on."""
        for frame in clip.frames[first:]:
            self.show(clip, frame)
            yield

    @property
    def shown(self) -> Shown:
        """What the clip has set in the frame that is shown."""
        bones = self._armature_object.pose.bones
        numbers = {(datablock, path): read_value(datablock, path) for datablock, path in self._numbers}
        return Shown(tuple(read(bones, channel) for channel in POSE_CHANNELS), numbers)

    def put(self, shown: Shown, frame: int) -> None:
        """Go to a frame with what a clip has set in another; nothing drives the rig."""
        self.stop()
        for channel, values in zip(POSE_CHANNELS, shown.channels, strict=True):
            write(self._armature_object.pose.bones, channel, values)
        for (datablock, path), value in shown.numbers.items():
            set_value(datablock, path, value)
        for datablock in {self._armature_object, *(datablock for datablock, _ in shown.numbers)}:
            datablock.update_tag()
        bpy.context.scene.frame_set(frame)

    def stop(self) -> None:
        """Let nothing drive the rig; it is at rest, its numbers as in the file."""
        if self._clip is not None:
            self._clip = None
            animation = self._armature_object.animation_data
            if animation is not None:
                animation.use_nla, animation.action = False, None
            for datablock, state in zip(self._others, self._idle, strict=True):
                _restore(datablock, state)
            self._reset()

    def _start(self, clip: Clip) -> None:
        self.stop()
        if self._idle is None:
            self._idle = [_state(datablock) for datablock in self._others]
        self._clip = clip
        self._reset()
        driven = [d for d in (self._armature_object, *self._others) if _drives(clip, d)]
        for datablock in driven:
            if clip.kind == ACTION:
                assign_action(datablock, bpy.data.actions[clip.name])
            else:
                datablock.animation_data.action, datablock.animation_data.use_nla = None, True

    def _reset(self) -> None:
        clear_pose(self._armature_object)
        self.restore_numbers()

    def restore_numbers(self) -> None:
        """Set the numbers to what they are in the file."""
        for (datablock, path), value in self._numbers.items():
            set_value(datablock, path, value)
        for scene_rig, name, value in self._controls:
            set_control(scene_rig, name, value)
        for datablock in {datablock for datablock, _ in self._numbers}:
            datablock.update_tag()


@contextmanager
def clip_player(rigs: Controlled, clips: tuple[Clip, ...]) -> Iterator[ClipPlayer]:
    """Play clips, and give back what animates the datablocks of rigs and the numbers that the clips animate.

    It is entered before `temporary_pose`, which gives back the armature object's own animation and the frame.

    Raises:
        RigError: as `ClipPlayer`.
    """
    player = ClipPlayer(rigs, clips)
    states = [(datablock, _state(datablock)) for datablock in _others(rigs)]
    try:
        yield player
    finally:
        for datablock, state in states:
            _restore(datablock, state)
        # What animates them again is evaluated first: the numbers may differ from its keys.
        bpy.context.view_layer.update()
        player.restore_numbers()
        bpy.context.view_layer.update()


def clip_actions(armature_object: bpy.types.Object, clips: tuple[Clip, ...]) -> list[bpy.types.Action]:
    """The actions that drive the armature object while clips are shown, for `temporary_pose`."""
    return _actions(clips, armature_object)


def _others(rigs: Controlled) -> list[bpy.types.ID]:
    """The datablocks of rigs beside the armature object, each once."""
    meshes = [scene_rig.mesh_object for scene_rig, _ in rigs]
    found = [rigs[0][0].armature_object.data]
    found += [datablock for mesh_object in meshes for datablock in (mesh_object, mesh_object.data.shape_keys)]
    return list(dict.fromkeys(datablock for datablock in found if datablock is not None))


def _actions(clips: tuple[Clip, ...], datablock: bpy.types.ID) -> list[bpy.types.Action]:
    actions = [bpy.data.actions[clip.name] for clip in clips if clip.kind == ACTION]
    if datablock.animation_data is not None and any(clip.kind != ACTION for clip in clips):
        actions += driving_actions(datablock.animation_data)
    return actions


def _drives(clip: Clip, datablock: bpy.types.ID) -> bool:
    """Whether a clip animates a datablock."""
    if clip.kind == ACTION:
        return bool(curves_of(bpy.data.actions[clip.name], datablock))
    return datablock.animation_data is not None and len(datablock.animation_data.nla_tracks) > 0


def _is_channel(path: str) -> bool:
    """Whether a path is a channel of a pose, which `clear_pose` brings to rest."""
    return path.startswith("pose.bones[") and path.rpartition(".")[2] in {
        "location",
        "scale",
        "rotation_euler",
        "rotation_quaternion",
        "rotation_axis_angle",
    }


def _state(datablock: bpy.types.ID) -> tuple | None:
    animation = datablock.animation_data
    if animation is None:
        return None
    return animation.action, getattr(animation, "action_slot", None), animation.use_nla


def _restore(datablock: bpy.types.ID, state: tuple | None) -> None:
    """Let what animated a datablock when `_state` was called animate it again, if something else does."""
    if state == _state(datablock):
        return
    if state is None:
        datablock.animation_data_clear()
        return
    animation, (action, slot, use_nla) = datablock.animation_data, state
    animation.action = action
    if action is not None and hasattr(animation, "action_slot"):
        # Also where it was none: Blender chooses one when an action is assigned.
        animation.action_slot = slot
    animation.use_nla = use_nla
