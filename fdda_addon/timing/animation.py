# SPDX-License-Identifier: GPL-3.0-or-later
"""The animation whose frames are timed: the action of an armature, or random poses."""

from collections.abc import Iterator
from contextlib import contextmanager

import bpy

from ..core.mathematics.poses import CONTROL, ROTATION, ROTATION_VECTOR, Channel, sample_pose
from ..core.recording.index import ACTION
from ..poses.action_range import action_frames
from ..poses.clip import Clip
from ..poses.clip_player import clip_player
from ..poses.sampling import sampled_channels
from ..rig.reading import read_rig
from ..scene.action_slots import active_action
from ..scene.armature import FOUR_COMPONENT_ROTATIONS, Poser, clear_pose
from ..scene.comparison import hidden_comparison_objects
from ..scene.scene_rig import SceneRig, armature_modifier
from ..scene.time_stretching import unstretched_time

RANDOM_POSE_COUNT, KEY_STEP_FRAMES = 20, 5
"""Number of random poses that animate a rig without an action, and the number of frames from one to the next."""


def main_rig(rigs: list[SceneRig]) -> SceneRig:
    """Return the rig whose bones are animated: that of the largest mesh with an Armature modifier, if there is one."""
    return max(rigs, key=lambda r: (armature_modifier(r.mesh_object) is not None, len(r.mesh_object.data.vertices)))


@contextmanager
def temporary_animation(scene_rig: SceneRig, channels: tuple[Channel, ...] = ()) -> Iterator[range]:
    """Play the active action of a rig, or `key_random_poses` if it has none; restore pose and animation afterwards.

    Yields:
        The frames of the action.
    """
    armature_object, mesh_object = scene_rig.armature_object, scene_rig.mesh_object
    action = active_action(armature_object, mesh_object)
    clips = (Clip(ACTION, action.name, action_frames(action)),) if action else ()
    with hidden_comparison_objects(), clip_player([(scene_rig, ())], clips) as player, unstretched_time():
        if clips:
            player.start(clips[0])
            yield clips[0].frames
            return
        action = key_random_poses(scene_rig, channels)
        try:
            yield action_frames(action)
        finally:
            armature_object.animation_data.action = None
            bpy.data.actions.remove(action)


def key_random_poses(scene_rig: SceneRig, channels: tuple[Channel, ...] = ()) -> bpy.types.Action:
    """Key random poses on the armature, `KEY_STEP_FRAMES` frames apart, and return its action.

    Args:
        channels: the channels of the poses, without controls; empty for the sampled channels of the rig.
    """
    armature_object = scene_rig.armature_object
    channels = [c for c in channels or sampled_channels(scene_rig, read_rig(scene_rig)) if c.kind != CONTROL]
    clear_pose(armature_object)
    poser = Poser(scene_rig, channels)
    for index in range(RANDOM_POSE_COUNT):
        poser.set(sample_pose(channels, 0, index))
        for name, kind in {(channel.name, channel.kind) for channel in channels}:
            bone = armature_object.pose.bones[name]
            is_rotation = kind in {ROTATION, ROTATION_VECTOR}
            path = FOUR_COMPONENT_ROTATIONS.get(bone.rotation_mode, "rotation_euler") if is_rotation else kind
            bone.keyframe_insert(path, frame=1 + index * KEY_STEP_FRAMES)
    return armature_object.animation_data.action
