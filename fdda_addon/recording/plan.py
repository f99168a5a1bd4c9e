# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings of a recording, and what follows from them for a rig before a pose is evaluated."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import bpy

from ..core.controls import Control
from ..core.defaults import INFLUENCE_POSES, MARGIN, MIN_PARTITION_VERTICES, POSES, SPREAD
from ..core.partition import INFLUENCE_TOLERANCE
from ..core.poses import Channel, Margin, make_margin
from ..core.recording.index import RANDOM, Sampling, Source
from ..core.recording.target import POSE
from ..core.rig import Rig
from ..poses.clip import find_clips
from ..poses.sample_selection import SampleSelection, select_bones
from ..poses.sampling import (
    ControlRanges,
    locked_channels,
    parse_sample_selection,
    sampled_channels,
    sampled_numbers,
)
from ..rig.dependencies import read_dependencies
from ..rig.pose_setter import NO_TARGET, TargetSettings
from ..rig.reading import read_rig
from ..rig.target import find_target
from ..scene.controls import parse_controls
from ..scene.scene_rig import SceneRig


@dataclass(frozen=True)
class RecordingSettings:
    """Settings of a recording.

    Attributes:
        poses: number of random poses.
        seed: of the random poses.
        spread: standard deviation of the random poses as a ratio of half the range of motion.
        margin: scale of the range of motion for some of the random poses (`core.poses.make_margin`); 1 for none.
        actions, strips: names of actions, and of strips of the NLA, whose frames are recorded after the random poses.
        mirror: record each of these frames a second time, mirrored.
        influence_poses: how many times each joint is moved alone to find the partitions that it influences.
        influence_tolerance: a joint influences a residual that it changes by more than this ratio of the rig's size.
        resume: continue an interrupted recording.
        overwrite: replace a recording in the folder.
        sample: control bones that the random poses move, in the syntax of `sampling.parse_sample_selection`; empty for
            the default bones.
        fit_linear: kind of the skin weights that are fitted (`core.skin_fit.FIT_KINDS`); empty for those of the rig.
        controls: listed properties that are inputs beside the automatic ones, in the syntax of `parse_controls`.
        min_partition_vertices: partitions with fewer vertices are merged into others; 0 merges none.
        shard: number, from 1, and count of the shards, to record one of them; None for all poses.
        detect_influences: detect the influences of all shards, and record no poses.
        influences: folder of a recording that was made with `detect_influences` and the same settings; None detects
            them again. For several meshes it has a subfolder for each.
        target: whose surface is recorded.
    """

    poses: int = POSES
    seed: int = 0
    spread: float = SPREAD
    margin: float = MARGIN
    actions: tuple[str, ...] = ()
    influence_poses: int = INFLUENCE_POSES
    influence_tolerance: float = INFLUENCE_TOLERANCE
    resume: bool = False
    sample: tuple[str, ...] = ()
    controls: tuple[str, ...] = ()
    fit_linear: str = ""
    min_partition_vertices: int = MIN_PARTITION_VERTICES
    strips: tuple[str, ...] = ()
    mirror: bool = False
    shard: tuple[int, int] | None = None
    detect_influences: bool = False
    influences: Path | None = None
    target: TargetSettings = NO_TARGET
    overwrite: bool = False


def read_sampled_rig(scene_rig: SceneRig, settings: RecordingSettings) -> tuple[Rig, tuple[Channel, ...]]:
    """Read the rig with the controls and the channels of these settings.

    Raises:
        RigError: the rig cannot be read, or has nothing to sample.
    """
    selection, extra_joints = read_sample_selection(scene_rig, settings)
    rig = read_rig(scene_rig, extra_joints, depends_on_time(scene_rig, settings))
    channels = sampled_channels(scene_rig, rig, selection) if settings.poses else ()
    return replace(rig, controls=selection.controls), channels


def depends_on_time(scene_rig: SceneRig, settings: RecordingSettings) -> bool:
    """Return whether the target of the settings depends on more than the pose, as a simulation does.

    Raises:
        RigError: as `find_target`.
    """
    return bool(settings.target.name) and find_target(scene_rig, settings.target.name).follows != POSE


def read_sample_selection(
    scene_rig: SceneRig, settings: RecordingSettings
) -> tuple[SampleSelection, frozenset[str] | None]:
    """Read what the settings sample, and the joints of the rig beside the bones with weights (`read_rig`).

    Where control bones are sampled, the joints are the bones with weights and other bones on which the mesh depends.
    Control bones are no inputs of a model, only the bones that follow them.

    Raises:
        RigError: the rig lacks what the settings name.
    """
    dependencies = read_dependencies(scene_rig, find_actions(settings))

    def find_controls(sampled: ControlRanges) -> Iterator[Control]:
        yield from dependencies.controls
        yield from parse_controls(scene_rig, settings.controls, sampled)

    selection = parse_sample_selection(scene_rig, settings.sample, find_controls)
    return selection, None if selection.bones is None else dependencies.bones


def listed_controls(scene_rig: SceneRig, settings: RecordingSettings) -> tuple[Control, ...]:
    """Return the controls that are listed in the settings.

    Raises:
        RigError: the rig lacks a control, or its range is unknown.
    """
    sampled = sampled_numbers(scene_rig, select_bones(scene_rig, settings.sample)) if settings.controls else {}
    return parse_controls(scene_rig, settings.controls, sampled)


def find_actions(settings: RecordingSettings) -> tuple[bpy.types.Action, ...]:
    """Return the actions of the settings that exist in the file."""
    return tuple(bpy.data.actions[name] for name in settings.actions if name in bpy.data.actions)


def make_sampling(scene_rig: SceneRig, settings: RecordingSettings, channels: tuple[Channel, ...]) -> Sampling:
    """Make the sampling of a recording with these settings.

    Raises:
        RigError: there is no action or strip of a name that the settings have.
    """
    sources = [Source(RANDOM, settings.poses)] if settings.poses else []
    clips = find_clips(scene_rig.armature_object, settings.actions, settings.strips, settings.mirror)
    sources += [clip.source for clip in clips]
    sampled = channels if settings.poses else ()
    margin = make_recording_margin(scene_rig, settings, sampled)
    return Sampling(settings.seed, settings.spread, sampled, tuple(sources), margin)


def make_recording_margin(
    scene_rig: SceneRig, settings: RecordingSettings, channels: tuple[Channel, ...]
) -> Margin | None:
    """Make the margin of the random poses, whose `channels` are sampled inside the range of motion."""
    locked = locked_channels(scene_rig.armature_object, channels)
    return make_margin(channels, locked, settings.margin, settings.poses if channels else 0)
