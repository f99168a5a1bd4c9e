# SPDX-License-Identifier: GPL-3.0-or-later
"""Shows the frames of clips: assigns an action to the datablocks that it animates, or enables their NLA."""

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

import bpy
import numpy as np

from ..core.errors import RigError
from ..core.recording.index import ACTION
from ..scene.action_slots import dependencies, slots_of_action
from ..scene.animated_values import animated_values, driving_actions, read_value, set_value
from ..scene.armature import clear_pose
from ..scene.arrays import POSE_CHANNELS, read, write
from ..scene.controls import can_be_set, is_number, owner_of, set_control
from ..scene.scene_rig import SceneRig
from ..scene.temporary_state import (
    AnimationState,
    animation_state,
    assign_action,
    restore_animation,
    temporary_pose,
)
from ..scene.unit import metres_per_unit
from .clip import Clip

PropertyValues = dict[tuple[bpy.types.ID, str], object]
"""Values by datablock and RNA path."""

ControlledRigs = Sequence[tuple[SceneRig, Iterable[str]]]
"""Rigs of one armature, each with the names of controls that the caller sets between frames."""


MIN_DISTANCE_TOLERANCE, RELATIVE_DISTANCE_TOLERANCE = 1e-3, 1e-3
"""Largest distance between an end of a bone and its mirror image: the larger of a distance in meters and a ratio of the
armature's size."""
AXIS_TOLERANCE = 1e-2
"""Largest angle between an axis of a bone and the same axis of its mirror image, radians."""

_MIRROR_SIGNS = {
    "location": (-1, 1, 1),
    "rotation_euler": (1, -1, -1),
    "rotation_quaternion": (1, 1, -1, -1),
    "rotation_axis_angle": (1, 1, -1, -1),
    "scale": (1, 1, 1),
}
_QUOTED_NAME = re.compile(r'\["((?:[^"\\]|\\.)*)"\]')


def flipped_name(name: str) -> str:
    """Return the name for the other side, such as `arm.R` for `arm.L`; a name without a side is returned unchanged."""
    namespace, colon, base_name = name.rpartition(":")
    return namespace + colon + bpy.utils.flip_name(base_name)


class Mirror:
    """Mirrors the pose of an armature about its YZ plane, and numbers that have a left and a right side.

    Attributes:
        partner_paths: the RNA path on the other side, by datablock and RNA path of each number that is exchanged.
    """

    def __init__(self, armature_object: bpy.types.Object, animated_numbers: Iterable[tuple[bpy.types.ID, str]] = ()):
        """Prepare to mirror poses.

        Args:
            animated_numbers: datablocks and RNA paths of numbers to exchange with the other side, in addition to
                custom properties of bones.
        """
        self._armature_object = armature_object
        indices = {bone.name: index for index, bone in enumerate(armature_object.pose.bones)}
        self._partner_indices = np.array(
            [indices.get(flipped_name(name), index) for name, index in indices.items()], int
        )
        # Check that each bone is the mirror image of its partner.
        partner_indices, bones = self._partner_indices, armature_object.data.bones
        matrices = np.array([bone.matrix_local for bone in bones], np.float64).reshape(-1, 4, 4)
        tails = np.array([bone.tail_local for bone in bones], np.float64).reshape(-1, 3)
        reflection = np.diag([-1.0, 1.0, 1.0, 1.0])
        offsets = reflection @ matrices[partner_indices] @ reflection - matrices
        distances = np.maximum(
            np.linalg.norm(offsets[:, :3, 3], axis=1),
            np.linalg.norm(tails[partner_indices] * [-1, 1, 1] - tails, axis=1),
        )
        size = float(np.ptp(np.concatenate([matrices[:, :3, 3], tails]), axis=0).max())
        tolerance = max(MIN_DISTANCE_TOLERANCE / metres_per_unit(armature_object), RELATIVE_DISTANCE_TOLERANCE * size)
        is_apart = (distances > tolerance) | (np.linalg.norm(offsets[:, :3, :3], axis=1).max(axis=1) > AXIS_TOLERANCE)
        for index, bone in enumerate(armature_object.pose.bones):
            partner, expected_name = armature_object.pose.bones[int(partner_indices[index])], flipped_name(bone.name)
            if not is_apart[index] and bone.rotation_mode == partner.rotation_mode:
                continue
            problem = f"the bone '{bone.name}' differs from its mirror image; bring it into the middle"
            if partner != bone:
                problem = (
                    f"the bones '{bone.name}' and '{partner.name}' differ in place, roll, direction or rotation mode; "
                    "symmetrize the armature"
                )
            elif expected_name != bone.name:
                problem = f"there is no bone '{expected_name}' for '{bone.name}'; add it"
            raise RigError(f"'{armature_object.name}' cannot be mirrored: {problem}, or leave mirroring out.")
        escape = bpy.utils.escape_identifier
        paths = {
            (armature_object, f'{bone.path_from_id()}["{escape(key)}"]')
            for bone in armature_object.pose.bones
            for key in bone.keys()  # noqa: SIM118
        }
        self.partner_paths: dict[tuple[bpy.types.ID, str], str] = {}
        for datablock, path in {*paths, *animated_numbers}:
            partner_path = flipped_path(path)
            if partner_path != path and is_number(datablock, path) and is_number(datablock, partner_path):
                self.partner_paths |= {(datablock, path): partner_path, (datablock, partner_path): path}

    def apply(self) -> None:
        """Mirror the current pose and numbers without evaluating them."""
        bones = self._armature_object.pose.bones
        for channel in POSE_CHANNELS:
            write(bones, channel, read(bones, channel)[self._partner_indices] * np.float32(_MIRROR_SIGNS[channel.name]))
        values = {number: number[0].path_resolve(partner) for number, partner in self.partner_paths.items()}
        for (datablock, path), value in values.items():
            set_value(datablock, path, value)
        for datablock in {datablock for datablock, _ in values} | {self._armature_object}:
            # Custom properties do not tag their datablock.
            datablock.update_tag()


def flipped_path(path: str) -> str:
    """Return an RNA path for the other side."""

    def flip(match: re.Match) -> str:
        return f'["{bpy.utils.escape_identifier(flipped_name(bpy.utils.unescape_identifier(match[1])))}"]'

    return _QUOTED_NAME.sub(flip, path)


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
        animated_numbers = {
            (datablock, path): value
            for datablock in (*self.armature_objects, *self.other_datablocks)
            for path, value in animated_values(datablock, actions_of_clips(clips, datablock)).items()
            # `clear_pose` resets the channels of a pose.
            if not (path.startswith("pose.bones[") and path.rpartition(".")[2] in _MIRROR_SIGNS)
        }
        self._mirrors: list[Mirror] = []
        if any(clip.is_mirrored for clip in clips):
            # Armatures that only follow the animated ones need not be symmetric.
            mirrored = [a for a in self.armature_objects if a in animated_datablocks] or [armature_object]
            for armature in mirrored:
                others = {*mirrored, *(self.other_datablocks if armature != mirrored[0] else ())} - {armature}
                self._mirrors.append(Mirror(armature, [key for key in animated_numbers if key[0] not in others]))
            animated_numbers |= {
                (datablock, path): datablock.path_resolve(path)
                for mirror in self._mirrors
                for datablock, path in mirror.partner_paths
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
        elif clip.is_mirrored:
            self.reset_pose()
        bpy.context.scene.frame_set(frame)
        if clip.is_mirrored:
            for mirror in self._mirrors:
                mirror.apply()

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
