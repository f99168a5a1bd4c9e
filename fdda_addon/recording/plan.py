# SPDX-License-Identifier: GPL-3.0-or-later
"""What a recording will hold, before a pose is evaluated: the settings, and what they come to for a rig."""

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
from ..poses.sampling import Ranges, choose, locked_channels, sampled_channels, sampled_numbers
from ..rig.dependencies import read_dependencies
from ..rig.pose_setter import NO_TARGET, TargetSettings
from ..rig.reading import read_rig
from ..rig.target import find_target
from ..scene.controls import parse_controls
from ..scene.scene_rig import SceneRig


@dataclass(frozen=True)
class RecordingSettings:
    """What to record.

    Attributes:
        poses: number of random poses.
        seed: of the random poses.
        spread: standard deviation of the random poses as a part of half the range of motion.
        margin: how many times as wide as the range of motion some of the random poses are (`core.poses.make_margin`); 1
            for none of them.
        actions, strips: names of actions, and of strips of the NLA, whose frames are recorded after the random poses.
        mirror: record each of these frames a second time, mirrored.
        influence_poses: how often each joint is moved alone to find the partitions that it influences.
        influence_tolerance: part of the character's size by which a joint moves the residuals that it influences.
        resume: continue a recording that was interrupted.
        overwrite: replace a recording that is in the folder.
        sample: which control bones the random poses move, as `sampling.choose` reads it; empty for those of the rig.
        fit_linear: kind of the skin weights that are fitted (`core.skin_fit.KINDS`); empty for those of the rig.
        controls: which numbers are inputs and are sampled beside those that are found, as `parse_controls` reads it.
        min_partition_vertices: partitions of fewer vertices are merged into others; 0 merges none.
        shard: record this part of the poses, its number from 1 and how many parts there are; None for all.
        detect_influences: find what a recording needs before its first pose, and record none.
        influences: folder with what `detect_influences` found, of the same rig and settings; found anew when left out.
            Where several meshes are recorded, it has a folder of the same name for each.
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
    """The rig with its controls, and the channels of its random poses, as these settings record it.

    Raises:
        RigError: the rig cannot be read, or nothing may be sampled.
    """
    choice, extra_joints = read_sampling_choice(scene_rig, settings)
    rig = read_rig(scene_rig, extra_joints, depends_on_time(scene_rig, settings))
    channels = sampled_channels(scene_rig, rig, choice) if settings.poses else ()
    return replace(rig, controls=choice.controls), channels


def depends_on_time(scene_rig: SceneRig, settings: RecordingSettings) -> bool:
    """Whether these settings have a target that does not follow from the pose at once: what sags, for example.

    Raises:
        RigError: as `find_target`.
    """
    return bool(settings.target.name) and find_target(scene_rig, settings.target.name).follows != POSE


def read_sampling_choice(
    scene_rig: SceneRig, settings: RecordingSettings
) -> tuple[SampleSelection, frozenset[str] | None]:
    """What these settings sample, and which joints the rig has beside the bones that have weights (`read_rig`).

    The joints of a rig whose control bones are sampled are the bones that have weights, and those that the mesh depends
    on otherwise: what animators pose is no input of a model, what follows from it is.

    Raises:
        RigError: the rig lacks what the settings name.
    """
    dependencies = read_dependencies(scene_rig, find_actions(settings))

    def find_controls(sampled: Ranges) -> Iterator[Control]:
        yield from dependencies.controls
        yield from parse_controls(scene_rig, settings.controls, sampled)

    choice = choose(scene_rig, settings.sample, find_controls)
    return choice, None if choice.bones is None else dependencies.bones


def listed_controls(scene_rig: SceneRig, settings: RecordingSettings) -> tuple[Control, ...]:
    """The controls that these settings list.

    Raises:
        RigError: the rig lacks one, or nobody states its range.
    """
    sampled = sampled_numbers(scene_rig, select_bones(scene_rig, settings.sample)) if settings.controls else {}
    return parse_controls(scene_rig, settings.controls, sampled)


def find_actions(settings: RecordingSettings) -> tuple[bpy.types.Action, ...]:
    """The actions whose frames these settings record, as far as the file has them."""
    return tuple(bpy.data.actions[name] for name in settings.actions if name in bpy.data.actions)


def make_sampling(scene_rig: SceneRig, settings: RecordingSettings, channels: tuple[Channel, ...]) -> Sampling:
    """How the poses of a recording with these settings are chosen.

    Raises:
        RigError: there is no action or strip of a name that the settings have.
    """
    sources = [Source(RANDOM, settings.poses)] if settings.poses else []
    clips = find_clips(scene_rig.armature_object, settings.actions, settings.strips, settings.mirror)
    sources += [clip.source for clip in clips]
    own = channels if settings.poses else ()
    margin = make_recording_margin(scene_rig, settings, own)
    return Sampling(settings.seed, settings.spread, own, tuple(sources), margin)


def make_recording_margin(
    scene_rig: SceneRig, settings: RecordingSettings, channels: tuple[Channel, ...]
) -> Margin | None:
    """The margin of the random poses of a recording, of which `channels` are sampled inside the range of motion."""
    locked = locked_channels(scene_rig.armature_object, channels)
    return make_margin(channels, locked, settings.margin, settings.poses if channels else 0)
