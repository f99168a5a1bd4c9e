# SPDX-License-Identifier: GPL-3.0-or-later
"""Plans and sets the poses of a recording: random poses, then the frames of clips.

In some of these, the reference joints of the rig are found. A user can see random poses in advance.
"""

from collections.abc import Callable, Collection, Container, Iterator
from contextlib import closing, contextmanager, suppress
from copy import copy
from dataclasses import replace

import bpy
import numpy as np

from ..core.errors import RigError
from ..core.mathematics.poses import Channel
from ..core.mathematics.references import choose_references, has_reference_choice
from ..core.rig import Rig
from ..poses.clip import Clip
from ..poses.clip_player import ClipPlayer
from ..rig.pose_setter import DIRECT_POSE_SETTER, PoseSetter, blend_from_rest
from ..rig.reading import PoseReader
from ..rig.references import split_bone_path
from ..rig.shape_keys import set_keys_undriven
from ..rig.sources import Sources
from ..scene.armature import Poser, clear_pose
from ..scene.controls import can_be_set, control_default, is_driven, owner_of, set_control
from ..scene.scene_rig import SceneRig
from .plan import (
    RecordingSettings,
    make_pose_sampler,
    make_recording_overshoot,
    read_sample_selection,
    read_sampled_rig,
)

REPEATABILITY_INDEX_OFFSET = 1 << 36
"""First index of the random poses from which a pose is approached again to measure the repeatability.

No recording or evaluation has as many poses."""


class PosePlan:
    """Poses of a rig.

    Attributes:
        total, random_count: number of all poses, and of random poses, which come first.
        in_range_count: number of random poses inside the range of motion; the overshoot poses follow them.
    """

    def __init__(
        self,
        scene_rig: SceneRig,
        channels: tuple[Channel, ...],
        settings: RecordingSettings,
        clips: tuple[Clip, ...],
        pose_setter: PoseSetter = DIRECT_POSE_SETTER,
    ):
        """Plan the poses.

        Args:
            channels: channels of the random poses.
            settings: settings of the recording.
            clips: the clips whose frames follow the random poses.
            pose_setter: sets the poses, and waits for a target that depends on time.
        """
        self._scene_rig, self._channels = scene_rig, channels
        self._settings, self._clips = settings, clips
        self.pose_setter = pose_setter
        self.random_count = settings.poses
        self.total = settings.poses + sum(len(clip.frames) for clip in clips)
        self._overshoot = make_recording_overshoot(self._scene_rig, settings, self._channels)
        self.in_range_count = settings.poses - (self._overshoot.poses if self._overshoot else 0)
        self._sampler = make_pose_sampler(scene_rig, settings)
        self._posers: dict[bool, Poser] = {}
        """What sets poses in the range of motion (True), and poses of the overshoot."""

    def show_poses(self, player: ClipPlayer, pose_indices: Container[int]) -> Iterator[int]:
        """Set the poses with the given indices, one per iteration, and yield each index."""
        with self._random_poses_prepared():
            for index in range(self.random_count):
                if index in pose_indices:
                    self.pose_setter.set_pose(self._make_transition(index))
                    yield index
        clip_start = self.random_count
        for clip in self._clips:
            frame_indices = [index for index in range(len(clip.frames)) if clip_start + index in pose_indices]
            for index in self.pose_setter.show_frames(player, clip, frame_indices):
                yield clip_start + index
            clip_start += len(clip.frames)

    @contextmanager
    def _random_poses_prepared(self) -> Iterator[None]:
        with self.pose_setter.prepared(), set_keys_undriven(self._scene_rig, self._channels):
            yield

    def show_poses_again(self, pose_indices: Collection[int]) -> Iterator[int]:
        """Set settled random poses again, reached via other random poses, and yield each index."""
        with self._random_poses_prepared():
            for index in pose_indices:
                indices = (index, REPEATABILITY_INDEX_OFFSET + index)
                self.pose_setter.set_pose(*map(self._make_transition, indices))
                yield index

    def draw(self, index: int) -> tuple[tuple[Channel, ...], np.ndarray]:
        """Return the channels that a random pose sets, and their values."""
        channels, sampler = self._channels, self._sampler
        if self._overshoot and self.in_range_count <= index < REPEATABILITY_INDEX_OFFSET:
            channels, sampler = self._overshoot.channels, replace(sampler, remix=None)
        return channels, sampler.draw_pose(channels, index)

    def _make_transition(self, index: int) -> Callable[[float], None]:
        """Return a function that blends from the rest pose to a random pose by a factor of 0 to 1."""
        channels, values = self.draw(index)
        is_in_range = channels is self._channels
        if is_in_range not in self._posers:
            self._posers[is_in_range] = Poser(self._scene_rig, channels)
        return blend_from_rest(self._posers[is_in_range].set, channels, values)


MAX_POSES = 24
"""Largest number of random poses, and of frames of actions, in which the motions of joints are compared."""


def find_fixed_joints(scene_rig: SceneRig) -> set[str]:
    """Return the names of the bones that keep their parents as reference joints.

    What a driver reads of a bone without a parent is relative to the armature.
    """
    armature_object, read_bones = scene_rig.armature_object, set()
    sources = [Sources(scene_rig, mesh_object, follows_shape_keys=False) for mesh_object in scene_rig.mesh_objects]
    for _, curve in (owned_curve for each in sources for owned_curve in each.drivers.values()):
        for variable in curve.driver.variables:
            for target in (target for target in variable.targets if target.id == armature_object):
                is_number = variable.type == "SINGLE_PROP"
                name = split_bone_path(armature_object, target.data_path)[0] if is_number else target.bone_target
                bone = armature_object.pose.bones.get(name or "")
                if bone is not None and not bone.parent and variable.type in ("SINGLE_PROP", "TRANSFORMS"):
                    read_bones.add(bone.name)
    return read_bones


def find_references(
    scene_rig: SceneRig, rig: Rig, fixed_joints: Collection[str], plan: PosePlan, player: ClipPlayer
) -> Rig:
    """Return a rig with its reference joints (`core.mathematics.references`).

    Args:
        scene_rig, rig: the rig, prepared by `temporary_rig_state`.
        fixed_joints: result of `find_fixed_joints`.
        plan: plan of the poses.
        player: player of the clips of the plan.
    """
    armature_object = scene_rig.armature_object
    is_fixed = np.array([name in fixed_joints for name in rig.joint_names])
    if not has_reference_choice(rig, is_fixed):
        return rig
    # The joints follow a pose at once; only a simulated target does not.
    plan = copy(plan)
    plan.pose_setter = DIRECT_POSE_SETTER
    parts = (0, plan.random_count), (plan.random_count, plan.total)
    indices = {
        index
        for start, end in parts
        for index in np.linspace(start, end - 1, min(MAX_POSES, end - start)).round().astype(int).tolist()
    }
    reader, pose_matrices = PoseReader(scene_rig, rig.joint_names, rig.rest_matrices), []
    with closing(plan.show_poses(player, indices)) as poses:
        for _ in poses:
            depsgraph = bpy.context.evaluated_depsgraph_get()
            objects = (o.evaluated_get(depsgraph) for o in (scene_rig.mesh_object, armature_object))
            pose_matrices.append(reader.read(*objects))
    player.stop()
    clear_pose(armature_object)
    player.restore_numbers()
    return choose_references(rig, is_fixed, np.stack(pose_matrices))


def show_random_pose(scene_rig: SceneRig, settings: "RecordingSettings", index: int) -> int:
    """Set one of the random poses of a recording.

    Args:
        settings: settings of the recording.
        index: index of the random pose, from 0.

    Returns:
        The index of the pose that is shown: `index`, or the index of the last random pose if that is smaller.
    """
    settings = replace(settings, poses=max(1, settings.poses))
    index = min(index, settings.poses - 1)
    _, channels = read_sampled_rig(scene_rig, settings)
    clear_pose(scene_rig.armature_object)
    channels, values = PosePlan(scene_rig, channels, settings, ()).draw(index)
    Poser(scene_rig, channels).set(values)
    scene_rig.armature_object.update_tag(refresh={"DATA"})
    return index


def show_rest_pose(scene_rig: SceneRig, settings: "RecordingSettings | None") -> None:
    """Set the rest pose, and the extra inputs of random poses to their defaults; inputs with drivers keep theirs.

    Args:
        settings: settings of the recording; None to keep the extra inputs.
    """
    clear_pose(scene_rig.armature_object)
    if settings is None:
        return
    # While a chosen bone or action is missing, random poses change no input.
    with suppress(RigError):
        for control in read_sample_selection(scene_rig, settings)[0].controls:
            if can_be_set(control.name) and not is_driven(owner_of(scene_rig, control.owner), control.path):
                set_control(scene_rig, control.name, control_default(scene_rig, control.name))
