# SPDX-License-Identifier: GPL-3.0-or-later
"""Turns poses of a rig into a recording."""

import contextlib
from collections.abc import Callable, Container, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import bpy
import numpy as np

from .core.errors import RecordingError
from .core.output import check_folder_writable
from .core.partition import GOLDEN_RATIO, INFLUENCE_TOLERANCE, LEAST_VERTICES, merged_partitions
from .core.poses import DEFAULT_SPREAD, Channel, sample_pose
from .core.progress import Progress
from .core.recording import RecordingInfo, Sampling, Source
from .core.recording_extension import RecordingExtension
from .core.recording_index import RANDOM
from .core.recording_writer import RecordingWriter
from .core.rig import Rig
from .core.skinning import LinearLayer
from .influences import Search, find_influences
from .residuals import local_residuals
from .scene.armature import Poser
from .scene.borrowed_rig import borrowed_rig
from .scene.clip import Clip, find_clips
from .scene.clip_player import ClipPlayer
from .scene.controls import stated_controls
from .scene.dependencies import read_dependencies
from .scene.rig import PoseEvaluator, SceneRig, check_evaluable, read_rig, sampled_channels
from .scene.sampling import Choice, choose
from .weight_fitting import check_has_weights, fit_weights, poses_to_fit, recorded_weights

BATCH_BYTES = 6 << 20
BATCH_POSES = 250
"""Poses go to the disk in batches of at most this size, so that an interruption loses little."""

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

    Raises:
        RigError: the rig cannot be recorded.
        TrainingError: weights are to be fitted, and the trainer's Python cannot.
        RecordingError: there is a recording already, or the one to resume is of something else.
        OutputError: the folder cannot be written.
    """
    clips = find_clips(scene_rig.armature_object, settings.actions, settings.strips, settings.mirror)
    if settings.mirror and not clips:
        raise RecordingError("There is nothing to mirror: no action and no strip; give --action or --strip.")
    check_evaluable(scene_rig)
    rig, channels = planned_rig(scene_rig, settings)
    check_folder_writable(path)
    sampling = planned_sampling(scene_rig, settings, channels)
    total = sum(source.poses for source in sampling.sources)
    if total < 1:
        raise RecordingError("There is nothing to record: 0 poses and no action; give --poses or --action.")
    info = RecordingInfo(
        total, 0, Path(bpy.data.filepath).name, scene_rig.mesh_object.name, bpy.app.version_string, sampling
    )

    def poses(player: ClipPlayer, wanted: Container[int]) -> Iterator[None]:
        return _poses(scene_rig, channels, settings, clips, player, wanted)

    rig, fit = yield from _linear_layer(scene_rig, rig, channels, path, settings, poses)
    with borrowed_rig(scene_rig, rig, channels, clips) as player:
        evaluator = PoseEvaluator(scene_rig, rig)
        search = Search(
            channels,
            lambda number: sample_pose(channels, settings.seed, INFLUENCE_SEED_OFFSET + number, settings.spread),
            lambda number: _show_frame(player, clips, number),
            player.stop,
            settings.influence_poses,
            settings.influence_tolerance,
        )
        cut = merged_partitions(rig, settings.least_vertices)
        partitions = yield from find_influences(scene_rig, rig, cut, evaluator, search)
        layer = LinearLayer(rig, partitions)
        with RecordingWriter(path, rig, partitions, replace(info, fit=fit), settings.resume) as writer:
            yield Progress("poses", writer.complete, total)
            left = poses(player, range(writer.complete, total))
            # Closed before the writer: what was evaluated is kept when the recording is broken off.
            with contextlib.closing(append_poses(left, evaluator, layer, writer)) as steps:
                for done in steps:
                    yield Progress("poses", done, total)


def _linear_layer(
    scene_rig: SceneRig,
    rig: Rig,
    channels: tuple[Channel, ...],
    path: Path,
    settings: RecordingSettings,
    poses: Callable[[ClipPlayer, Container[int]], Iterator[None]],
) -> Iterator[Progress]:
    """Returns the rig with the weights that its linear layer is to have, and the SkinFit, None for those of the rig."""
    if settings.resume and (recorded := recorded_weights(path, rig, settings.fit_linear)):
        return recorded
    if not settings.fit_linear:
        check_has_weights(scene_rig, rig)
        return rig, None
    sampling = planned_sampling(scene_rig, settings, channels)
    numbers = poses_to_fit(sum(source.poses for source in sampling.sources), rig.vertex_count)
    clips = find_clips(scene_rig.armature_object, settings.actions, settings.strips, settings.mirror)
    with borrowed_rig(scene_rig, rig, channels, clips) as player:
        posed = poses(player, frozenset(numbers))
        return (yield from fit_weights(rig, settings.fit_linear, posed, len(numbers), PoseEvaluator(scene_rig, rig)))


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


def _poses(
    scene_rig: SceneRig,
    channels: tuple[Channel, ...],
    settings: RecordingSettings,
    clips: tuple[Clip, ...],
    player: ClipPlayer,
    wanted: Container[int],
) -> Iterator[None]:
    """Pose the rig, one pose an iteration, as in the poses of the recording that are wanted, by their numbers."""
    poser = Poser(scene_rig, channels)
    for index in range(settings.poses):
        if index in wanted:
            poser.set(sample_pose(channels, settings.seed, index, settings.spread))
            yield
    frames = ((clip, frame) for clip in clips for frame in clip.frames)
    for index, (clip, frame) in enumerate(frames, settings.poses):
        if index in wanted:
            player.show(clip, frame)
            yield


def append_poses(
    poses: Iterator[None],
    evaluator: PoseEvaluator,
    layer: LinearLayer,
    writer: RecordingWriter | RecordingExtension,
) -> Iterator[int]:
    """Evaluate poses and append them to the recording in batches, one pose an iteration; how many it has is yielded.

    When it is closed, the poses that were evaluated are appended.
    """
    size = max(1, min(BATCH_POSES, BATCH_BYTES // (layer.rig.vertex_count * 12)))
    done = writer.complete
    with ThreadPoolExecutor(max_workers=1) as appending:
        # While a batch is turned into residuals and written, Blender evaluates the next one.
        previous: Future | None = None
        batch: list[tuple] = []
        try:
            for _ in poses:
                batch.append(evaluator.evaluate())
                done += 1
                if len(batch) == size:
                    if previous is not None:
                        previous.result()
                    previous = appending.submit(_append, writer, layer, batch)
                    batch = []
                yield done
        except GeneratorExit:
            _append_last(previous, writer, layer, batch)
            raise
        _append_last(previous, writer, layer, batch)


def _append_last(
    previous: Future | None, writer: RecordingWriter | RecordingExtension, layer: LinearLayer, batch: list[tuple]
) -> None:
    if previous is not None:
        previous.result()
    if batch:
        _append(writer, layer, batch)


def _append(writer: RecordingWriter | RecordingExtension, layer: LinearLayer, batch: list[tuple]) -> None:
    pose_matrices, positions, controls = (np.stack(arrays) for arrays in zip(*batch, strict=True))
    writer.append(pose_matrices, local_residuals(layer, pose_matrices, positions), controls)


def _show_frame(player: ClipPlayer, clips: tuple[Clip, ...], number: int) -> None:
    """Pose the rig as on one of the frames of some clips, far apart for numbers that follow each other."""
    frames = [(clip, frame) for clip in clips for frame in clip.frames]
    player.show(*frames[int(number * GOLDEN_RATIO * len(frames)) % len(frames)])
