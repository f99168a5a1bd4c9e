# SPDX-License-Identifier: GPL-3.0-or-later
"""Turns poses of a rig into a recording."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import bpy

from .appender import Appender, append_poses
from .core.errors import RecordingError
from .core.output import check_folder_writable
from .core.partition import GOLDEN_RATIO, INFLUENCE_TOLERANCE, LEAST_VERTICES
from .core.poses import DEFAULT_SPREAD, Channel, sample_pose
from .core.progress import Progress
from .core.recording import RecordingInfo, Sampling, Source
from .core.recording_estimate import check_room, recording_bytes
from .core.recording_index import RANDOM
from .core.recording_writer import RecordingWriter
from .core.rig import Rig
from .core.skinning import LinearLayer
from .influences import Search
from .mesh_group import common_armature, controls_of_each, in_passes
from .pose_plan import PosePlan
from .recorder import Recorder, estimate, in_turn
from .scene.borrowed_rig import borrowed_rigs
from .scene.clip import Clip, find_clips
from .scene.clip_player import ClipPlayer
from .scene.controls import stated_controls
from .scene.dependencies import read_dependencies
from .scene.rig import PoseEvaluator, SceneRig, check_evaluable, read_rig, sampled_channels
from .scene.sampling import Choice, choose
from .weight_fitting import check_has_weights, fit_weights, poses_to_fit, recorded_weights

INFLUENCE_SEED_OFFSET = 1 << 32
"""Poses of the influence detection are drawn from indices that no pose of a recording reaches."""


@dataclass(frozen=True)
class RecordingSettings:
    """What to record.

    Attributes:
        poses: number of random poses.
        seed: of the random poses.
        spread: standard deviation of the random poses as a part of half the range of motion.
        actions, strips: names of actions, and of strips of the NLA, whose frames are recorded after the random poses.
        mirror: record each of these frames a second time, mirrored.
        influence_poses: how often each joint is moved alone to find the partitions that it influences.
        influence_tolerance: part of the character's size by which a joint moves the residuals that it influences.
        resume: continue a recording that was interrupted.
        sample: which control bones the random poses move, as `sampling.choose` reads it; empty for those of the rig.
        fit_linear: kind of the skin weights that are fitted (`core.skin_fit.KINDS`); empty for those of the rig.
        controls: which numbers are inputs and are sampled beside those that are found, as `stated_controls` reads it.
        least_vertices: partitions of fewer vertices are merged into others; 0 merges none.
    """

    poses: int = 1000
    seed: int = 0
    spread: float = DEFAULT_SPREAD
    actions: tuple[str, ...] = ()
    influence_poses: int = 10
    influence_tolerance: float = INFLUENCE_TOLERANCE
    resume: bool = False
    sample: tuple[str, ...] = ()
    controls: tuple[str, ...] = ()
    fit_linear: str = ""
    least_vertices: int = LEAST_VERTICES
    strips: tuple[str, ...] = ()
    mirror: bool = False


def record(scene_rig: SceneRig, path: Path, settings: RecordingSettings) -> Iterator[Progress]:
    """Record a rig; a generator that does the work while it is iterated.

    The scene is as before when the generator ends, is closed, or raises.

    Args:
        scene_rig: the rig.
        path: folder of the recording.
        settings: what to record.

    Yields:
        Progress of the stages "influences" and "poses", before them "poses to fit" and "fit" where weights are fitted.
        The first of the poses has a note of what they will take.

    Raises:
        RigError: the rig cannot be recorded.
        TrainingError: weights are to be fitted, and the trainer's Python cannot.
        RecordingError: there is a recording already, or the one to resume is of something else.
        OutputError: the folder cannot be written, or the disk lacks the room.
    """
    return record_meshes([(scene_rig, path)], settings)


def record_meshes(rigs: Sequence[tuple[SceneRig, Path]], settings: RecordingSettings) -> Iterator[Progress]:
    """As `record`, of several meshes on one armature, each into a folder of its own.

    They share the poses, and each pose is evaluated once for all meshes that can be evaluated together (`in_passes`).

    Raises:
        RigError: as `record`, or the meshes follow different armatures.
    """
    meshes = [scene_rig for scene_rig, _ in rigs]
    clips = find_clips(common_armature(meshes), settings.actions, settings.strips, settings.mirror)
    if settings.mirror and not clips:
        raise RecordingError("There is nothing to mirror: no action and no strip; give --action or --strip.")
    controls = [settings.controls] if len(rigs) == 1 else controls_of_each(meshes, settings.controls)
    recorders = []
    for (scene_rig, path), own in zip(rigs, controls, strict=True):
        check_evaluable(scene_rig)
        rig, channels = planned_rig(scene_rig, replace(settings, controls=own))
        check_folder_writable(path)
        recorders.append(Recorder(scene_rig, rig, path, channels))
    channels = [(recorder.scene_rig, recorder.channels) for recorder in recorders]
    plan = PosePlan(channels, settings.poses, settings.seed, settings.spread, clips)
    if plan.total < 1:
        raise RecordingError("There is nothing to record: 0 poses and no action; give --poses or --action.")
    check_room([(recorder.path, recording_bytes(recorder.rig, plan.total)) for recorder in recorders])
    for number, recorder in enumerate(recorders):
        recorder.limits = plan.channels_of(number)
    posed = [recorder.posed for recorder in recorders]
    with borrowed_rigs(posed, clips) if settings.fit_linear else nullcontext() as player:
        yield from in_turn(recorders, lambda recorder: _fit(recorder, settings, plan, player))
    for numbers in in_passes(meshes):
        together = [recorders[number] for number in numbers]
        others = [own for number, own in enumerate(posed) if number not in numbers]
        with borrowed_rigs([recorder.posed for recorder in together], clips, others) as player:
            yield from in_turn(together, lambda recorder: _find_influences(recorder, settings, clips, player))
            yield from _record_poses(together, settings, plan, player)


def _fit(recorder: Recorder, settings: RecordingSettings, plan: PosePlan, player: ClipPlayer) -> Iterator[Progress]:
    """Give the rig the weights that its linear layer is to have."""
    if settings.resume and (recorded := recorded_weights(recorder.path, recorder.rig, settings.fit_linear)):
        recorder.rig, recorder.fit = recorded
        return
    if not settings.fit_linear:
        check_has_weights(recorder.scene_rig, recorder.rig)
        return
    numbers = poses_to_fit(plan.total, recorder.rig.vertex_count)
    posed = plan.poses(player, frozenset(numbers))
    evaluator = PoseEvaluator(recorder.scene_rig, recorder.rig)
    recorder.rig, recorder.fit = yield from fit_weights(
        recorder.rig, settings.fit_linear, posed, len(numbers), evaluator
    )


def _find_influences(
    recorder: Recorder, settings: RecordingSettings, clips: tuple[Clip, ...], player: ClipPlayer
) -> Iterator[Progress]:
    """Find what influences the partitions of a mesh; what moves it alone is moved, not what moves others."""
    channels = recorder.channels
    search = Search(
        channels,
        lambda number: sample_pose(channels, settings.seed, INFLUENCE_SEED_OFFSET + number, settings.spread),
        lambda number: _show_frame(player, clips, number),
        player.stop,
        settings.influence_poses,
        settings.influence_tolerance,
    )
    yield from recorder.find_influences(search, settings.least_vertices)


def _record_poses(
    recorders: list[Recorder], settings: RecordingSettings, plan: PosePlan, player: ClipPlayer
) -> Iterator[Progress]:
    with ExitStack() as stack:
        appenders = []
        for recorder in recorders:
            sampling = planned_sampling(recorder.scene_rig, settings, recorder.limits)
            file, version = Path(bpy.data.filepath).name, bpy.app.version_string
            info = RecordingInfo(plan.total, 0, file, recorder.name, version, sampling, recorder.fit)
            rig, partitions = recorder.rig, recorder.partitions
            writer = stack.enter_context(RecordingWriter(recorder.path, rig, partitions, info, settings.resume))
            appenders.append(Appender(recorder.evaluator, LinearLayer(rig, partitions), writer))
        first = min(appender.done for appender in appenders)
        yield Progress("poses", first, plan.total, estimate(recorders, plan.total, plan.total - first))
        left = plan.poses(player, range(first, plan.total))
        # Closed before the writers: what was evaluated is kept when the recording is broken off.
        with closing(append_poses(left, appenders)) as steps:
            for done in steps:
                yield Progress("poses", done, plan.total)


def planned_rig(scene_rig: SceneRig, settings: RecordingSettings) -> tuple[Rig, tuple[Channel, ...]]:
    """The rig with its controls, and the channels of its random poses, as these settings record it.

    Raises:
        RigError: the rig cannot be read, or nothing may be sampled.
    """
    choice, besides = planned_choice(scene_rig, settings)
    rig = read_rig(scene_rig, besides)
    channels = sampled_channels(scene_rig, rig, choice) if settings.poses else ()
    return replace(rig, controls=choice.controls), channels


def planned_choice(scene_rig: SceneRig, settings: RecordingSettings) -> tuple[Choice, frozenset[str] | None]:
    """What these settings sample, and which joints the rig has beside the bones that have weights (`read_rig`).

    The joints of a rig whose control bones are sampled are the bones that have weights, and those that the mesh depends
    on otherwise: what animators pose is no input of a model, what follows from it is.

    Raises:
        RigError: the rig lacks what the settings name.
    """
    dependencies = read_dependencies(scene_rig)
    controls = {control.name: control for control in dependencies.controls}
    controls |= {control.name: control for control in stated_controls(scene_rig, settings.controls)}
    choice = choose(scene_rig, settings.sample, tuple(controls.values()))
    return choice, None if choice.bones is None else dependencies.bones


def planned_sampling(scene_rig: SceneRig, settings: RecordingSettings, channels: tuple[Channel, ...]) -> Sampling:
    """How the poses of a recording with these settings are chosen.

    Raises:
        RigError: there is no action or strip of a name that the settings have.
    """
    sources = [Source(RANDOM, settings.poses)] if settings.poses else []
    clips = find_clips(scene_rig.armature_object, settings.actions, settings.strips, settings.mirror)
    sources += [clip.source for clip in clips]
    return Sampling(settings.seed, settings.spread, channels if settings.poses else (), tuple(sources))


def _show_frame(player: ClipPlayer, clips: tuple[Clip, ...], number: int) -> None:
    """Pose the rig as on one of the frames of some clips, far apart for numbers that follow each other."""
    frames = [(clip, frame) for clip in clips for frame in clip.frames]
    player.show(*frames[int(number * GOLDEN_RATIO * len(frames)) % len(frames)])
