# SPDX-License-Identifier: GPL-3.0-or-later
"""Defines the settings of a recording, and derives the rig, channels and sampling from them before any evaluation."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import bpy

from ..core.controls import Control
from ..core.mathematics.poses import CONTROL, Channel, Overshoot, make_overshoot
from ..core.mathematics.remix import PoseSampler
from ..core.recording.index import INDEX_NAME, POSE, RANDOM, Sampling, Source, read_index, read_info
from ..core.rig import Rig
from ..core.settings import AUTO_POSES, MAX_AUTO_POSES, MIRROR, OVERSHOOT, POSES, SEED, SPREAD
from ..poses.clip import find_clips
from ..poses.remix import REMIX, read_remix
from ..poses.sample_selection import SampleSelection, select_bones, split_control_bones
from ..poses.sampling import (
    ControlRanges,
    controls_of_bones,
    default_channels,
    locked_channels,
    parse_sample_selection,
    sampled_channels,
    sampled_numbers,
)
from ..rig.dependencies import read_dependencies
from ..rig.pose_setter import NO_TARGET, TargetSettings
from ..rig.reading import read_rig
from ..rig.shape_keys import find_unposed_keys, key_distances
from ..rig.target import find_target
from ..scene.controls import parse_controls
from ..scene.scene_rig import SceneRig, find_character, find_rig

AUTO_SECONDS, AUTO_STEP, MAX_AUTO_BYTES = 60.0, 500, 4_000_000_000
"""Time and size of an automatic number of random poses, and what it is a multiple of."""
INFLUENCE_POSES = 4
"""Number of base poses from which each input is moved alone."""


@dataclass(frozen=True)
class RecordingSettings:
    """Settings of a recording.

    Attributes:
        poses: number of random poses.
        auto_poses: replace it by the number that is evaluated in about a minute (`automatic_poses`).
        seed: seed of the random poses.
        spread: standard deviation of the random poses as a ratio of half the range of motion.
        overshoot: factor that widens the range of motion for some random poses (`mathematics.poses.make_overshoot`); 1
            for none.
        actions, strips: names of actions, and of strips of the NLA, whose frames are recorded after the random poses.
        mirror: record each of these frames a second time, mirrored.
        influence_poses: number of base poses from which joints are moved alone, to find what they influence.
        resume: continue an interrupted recording.
        overwrite: replace a recording in the folder.
        bones_to_pose: bones that the random poses move, in the syntax of `sampling.parse_sample_selection`; empty for
            the default bones.
        extra_inputs: inputs besides the automatic ones, in the syntax of `split_control_bones` and `parse_controls`.
        target: settings of the target whose surface is recorded.
    """

    poses: int = POSES.field()
    auto_poses: bool = AUTO_POSES.field()
    seed: int = SEED.field()
    spread: float = SPREAD.field()
    overshoot: float = OVERSHOOT.field()
    actions: tuple[str, ...] = ()
    influence_poses: int = INFLUENCE_POSES
    resume: bool = False
    bones_to_pose: tuple[str, ...] = ()
    extra_inputs: tuple[str, ...] = ()
    strips: tuple[str, ...] = ()
    mirror: bool = MIRROR.field()
    target: TargetSettings = NO_TARGET
    overwrite: bool = False


def read_sampled_rig(scene_rig: SceneRig, settings: RecordingSettings) -> tuple[Rig, tuple[Channel, ...]]:
    """Read the rig with the controls of the settings, and find the channels of its random poses."""
    selection, extra_joints = read_sample_selection(scene_rig, settings)
    # A shape key that moves no vertex is no input.
    moving_keys = {
        name
        for mesh_object in scene_rig.mesh_objects
        for name, distances in key_distances(scene_rig, mesh_object).items()
        if distances.any()
    }
    controls = tuple(c for c in selection.controls if not c.is_shape_key or c.name in moving_keys)
    selection = replace(selection, controls=controls)
    rig = read_rig(scene_rig, extra_joints, depends_on_time(scene_rig, settings, selection.controls))
    return replace(rig, controls=controls), random_pose_channels(scene_rig, rig, selection) if settings.poses else ()


def automatic_poses(seconds_per_pose: float, bytes_per_pose: int, free_bytes: int) -> int:
    """Return the number of random poses that are evaluated in about a minute, 1,000 to 5,000.

    A recording of more than 1,000 takes 4 GB and half of the free space of the disk at most.
    """
    size = min(MAX_AUTO_BYTES, free_bytes / 2)
    count = min(AUTO_SECONDS / seconds_per_pose, size / bytes_per_pose, MAX_AUTO_POSES)
    return max(POSES.default, int(count) // AUTO_STEP * AUTO_STEP)


def keep_recorded_poses(settings: RecordingSettings, path: Path) -> RecordingSettings:
    """Return settings with the number of random poses of the recording in a folder in place of an automatic one.

    Without random poses, such as of a simulation, no bones are chosen for them.
    """
    if not settings.auto_poses or not (path / INDEX_NAME).exists():
        return settings
    sources = read_info(read_index(path)).sampling.sources
    poses = sum(s.poses for s in sources if s.kind == RANDOM)
    return replace(settings, poses=poses, auto_poses=False, bones_to_pose=settings.bones_to_pose if poses else ())


def random_pose_channels(scene_rig: SceneRig, rig: Rig, selection: SampleSelection) -> tuple[Channel, ...]:
    """Find the channels of random poses, as `sampled_channels` does, with channels of driven shape keys.

    A driven shape key that the other channels do not move is set without its driver (`set_keys_undriven`).
    """
    channels = sampled_channels(scene_rig, rig, selection)
    unposed_keys = find_unposed_keys(scene_rig, channels)
    key_channels = (
        Channel(control.name, CONTROL, 0, control.low, control.high)
        for control in selection.controls
        if control.is_shape_key and control.name in unposed_keys
    )
    # Bones that drive shape keys and are no joints act through these alone.
    keys = selection.key_bones.difference(rig.joint_names)
    keys |= {control.name for control in selection.controls if control.is_shape_key}
    return tuple(replace(channel, is_key=channel.name in keys) for channel in (*channels, *key_channels))


def make_pose_sampler(scene_rig: SceneRig, settings: RecordingSettings) -> PoseSampler:
    """Make the sampler of the random poses of a recording."""
    remix = None
    if REMIX in settings.bones_to_pose and settings.poses:
        remix = read_remix(scene_rig, find_actions(settings))
    return PoseSampler(settings.seed, settings.spread, remix)


def depends_on_time(scene_rig: SceneRig, settings: RecordingSettings, controls: Iterable[Control]) -> bool:
    """Return whether the target of the settings depends on more than pose and controls, as a simulation does."""
    name = settings.target.name
    return bool(name) and find_target(scene_rig, name, controls).follows != POSE


def read_sample_selection(
    scene_rig: SceneRig, settings: RecordingSettings
) -> tuple[SampleSelection, tuple[str, ...] | None]:
    """Read the sample selection of the settings, and the extra joints of the rig (`read_rig`).

    If control bones are sampled, the joints are the weighted bones and other bones on which the mesh depends. The
    inputs of a model are the bones that follow control bones, not the control bones themselves. A target may depend on
    every bone that has a range of motion.
    """
    actions = find_actions(settings)
    dependencies = read_dependencies(scene_rig, actions, has_random_poses=settings.poses > 0)
    control_bones, number_texts = split_control_bones(scene_rig, settings.extra_inputs)

    listed_names = set()

    def find_controls(sampled_ranges: ControlRanges) -> Iterator[Control]:
        yield from dependencies.controls
        for control in parse_controls(scene_rig, number_texts, sampled_ranges):
            listed_names.add(control.name)
            yield control

    selection = parse_sample_selection(scene_rig, settings.bones_to_pose, find_controls, control_bones, actions)
    # The selected actions may key numbers that act through shape keys alone.
    unlisted_names = dependencies.key_numbers - listed_names
    controls = tuple(control for control in selection.controls if control.name not in unlisted_names)
    selection = replace(selection, controls=controls, key_bones=dependencies.key_bones)
    bones, names = scene_rig.armature_object.data.bones, set(dependencies.bones)
    if selection.bones is None and not selection.control_bones:
        if not settings.target.name:
            return selection, None
        # Any bone that moves may move the target.
        names |= dependencies.key_bones
        names |= {channel.name for channel in default_channels(scene_rig.armature_object, set())}
        names |= {parent.name for name in names for parent in bones[name].parent_recursive}
    return selection, tuple(bone.name for bone in bones if bone.name in names)


def listed_controls(scene_rig: SceneRig, settings: RecordingSettings) -> tuple[Control, ...]:
    """Return the controls that are listed in the settings."""
    if not settings.extra_inputs:
        return ()
    control_bones, number_texts = split_control_bones(scene_rig, settings.extra_inputs)
    selection = select_bones(scene_rig, settings.bones_to_pose, control_bones, find_actions(settings))
    number_controls = parse_controls(scene_rig, number_texts, sampled_numbers(scene_rig, selection))
    return (*controls_of_bones(scene_rig, selection), *number_controls)


def find_actions(settings: RecordingSettings) -> tuple[bpy.types.Action, ...]:
    """Return the actions of the settings that exist in the file."""
    return tuple(bpy.data.actions[name] for name in settings.actions if name in bpy.data.actions)


def make_sampling(scene_rig: SceneRig, settings: RecordingSettings, channels: tuple[Channel, ...]) -> Sampling:
    """Make the description of the poses of a recording with these settings."""
    name = REMIX if REMIX in settings.bones_to_pose else ""
    sources = [Source(RANDOM, settings.poses, name)] if settings.poses else []
    clips = find_clips([scene_rig], settings.actions, settings.strips, settings.mirror)
    sources += [clip.source for clip in clips]
    sampled_channels_of_recording = channels if settings.poses else ()
    overshoot = make_recording_overshoot(scene_rig, settings, sampled_channels_of_recording)
    return Sampling(settings.seed, settings.spread, sampled_channels_of_recording, tuple(sources), overshoot)


def make_recording_overshoot(
    scene_rig: SceneRig, settings: RecordingSettings, channels: tuple[Channel, ...]
) -> Overshoot | None:
    """Make the overshoot of the random poses; `channels` are sampled within the range of motion."""
    fixed_channels = locked_channels(scene_rig.armature_object, channels)
    return make_overshoot(channels, fixed_channels, settings.overshoot, settings.poses if channels else 0)


def find_recorded_character(path: Path, object_name: str = "") -> SceneRig:
    """Find the rig of the meshes of a recording.

    Args:
        path: folder of the recording.
        object_name: name of the mesh object of a recording of one mesh; several meshes have their recorded names.
    """
    names = [mesh["name"] for mesh in read_index(path)["meshes"]]
    return find_character(names) if len(names) > 1 else find_rig(object_name)
