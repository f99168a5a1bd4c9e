# SPDX-License-Identifier: GPL-3.0-or-later
"""Records a rig: the phases of a recording, one after the other."""

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import bpy

from ..core.errors import RecordingError
from ..core.partition import GOLDEN_RATIO, assume_nearby_influences, make_merged_partitions
from ..core.poses import sample_pose
from ..core.progress import Progress
from ..core.recording.estimate import check_disk_space, recording_bytes
from ..core.recording.folder_check import check_recordable
from ..core.recording.index import INDEX, RecordingInfo
from ..core.recording.shard import Shard, shard_poses
from ..core.recording.target import POSE
from ..core.recording.writer import RecordingWriter
from ..core.skinning import LinearSkinning
from ..poses.clip import Clip, find_clips
from ..poses.clip_player import ClipPlayer
from ..rig.modifier_stack import check_evaluable
from ..rig.pose_setter import make_pose_setter
from ..rig.temporary_rig_state import temporary_rig_states
from ..rig.time_inputs import check_time_inputs
from ..scene.scene_rig import SceneRig
from .appender import Appender, append_poses
from .influences import Search, find_influences
from .mesh_group import common_armature, controls_of_each, in_passes
from .phases import InfluencesReady, MeshPlanned, TimedEvaluator, WeightsFitted, estimate
from .plan import RecordingSettings, find_actions, make_sampling, read_sampled_rig
from .pose_plan import PosePlan
from .previous_recording import check_influences_match, read_previous_partitions, read_previous_weights
from .repeatability import measure_repeatability
from .target_check import check_moves
from .time_check import check_follows_pose
from .weight_fitting import check_has_weights, fit_weights, poses_to_fit

Before, After = TypeVar("Before", MeshPlanned, WeightsFitted), TypeVar("After")
INFLUENCE_SEED_OFFSET = 1 << 32
"""Poses of the influence detection are drawn from indices that no pose of a recording reaches."""


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
    planned, plan = _plan(rigs, settings, clips)
    target = plan.pose_setter.target
    with target.prepared() if target else nullcontext():
        yield from _record_planned(planned, settings, clips, plan)


def _record_planned(
    planned: list[MeshPlanned], settings: RecordingSettings, clips: tuple[Clip, ...], plan: PosePlan
) -> Iterator[Progress]:
    meshes, posed = [mesh.scene_rig for mesh in planned], [mesh.posed for mesh in planned]
    with temporary_rig_states(posed, clips) if settings.fit_linear else nullcontext() as player:
        fitted = yield from _in_turn(planned, lambda mesh: _fit(mesh, settings, plan, player))
    for numbers in in_passes(meshes):
        together = [fitted[number] for number in numbers]
        others = [own for number, own in enumerate(posed) if number not in numbers]
        with temporary_rig_states([posed[number] for number in numbers], clips, others) as player:
            if plan.pose_setter.target:
                yield from check_moves(together[0], plan, player)
            check_follows_pose(together, plan, player)
            found = yield from _in_turn(together, lambda mesh: _find_influences(mesh, settings, clips, player))
            yield from _record_poses(found, settings, plan, player)


def _plan(
    rigs: Sequence[tuple[SceneRig, Path]], settings: RecordingSettings, clips: tuple[Clip, ...]
) -> tuple[list[MeshPlanned], PosePlan]:
    """The meshes with what moves them, and the poses that they share; all that can be refused is refused here."""
    if settings.mirror and not clips:
        raise RecordingError("There is nothing to mirror: no action and no strip; give --action or --strip.")
    meshes = [scene_rig for scene_rig, _ in rigs]
    controls = [settings.controls] if len(rigs) == 1 else controls_of_each(meshes, settings)
    if settings.target.name and len(rigs) > 1:
        raise RecordingError("A target is one of one mesh; record the meshes one by one, each with its target.")
    read = []
    for (scene_rig, path), own in zip(rigs, controls, strict=True):
        stack = check_evaluable(scene_rig)
        read.append(read_sampled_rig(scene_rig, replace(settings, controls=own)))
        if not settings.target.name:
            check_time_inputs(scene_rig, read[-1][0].controls, stack, find_actions(settings))
        check_recordable(path, settings.resume, settings.overwrite)
    channels = [(scene_rig, own) for scene_rig, (_, own) in zip(meshes, read, strict=True)]
    pose_setter = make_pose_setter(meshes[0], settings.target, clips, settings.poses)
    plan = PosePlan(channels, settings, clips, pose_setter)
    if plan.total < 1:
        raise RecordingError("There is nothing to record: 0 poses and no action; give --poses or --action.")
    wanted = len(_wanted(settings, plan.total))
    check_disk_space([(path, recording_bytes(rig, wanted)) for (_, path), (rig, _) in zip(rigs, read, strict=True)])
    known = [_known(path, settings, len(rigs) > 1) for _, path in rigs]
    planned = [
        MeshPlanned(scene_rig, rig, path, own, plan.channels_of(number), known[number], pose_setter.target)
        for number, ((scene_rig, path), (rig, own)) in enumerate(zip(rigs, read, strict=True))
    ]
    return planned, plan


def _known(path: Path, settings: RecordingSettings, is_one_of_several: bool) -> Path | None:
    """Where the weights and influences of the recording at `path` are known already, if they are."""
    if settings.resume and (path / INDEX).exists():
        return path
    if settings.influences is None:
        return None
    return settings.influences / path.name if is_one_of_several else settings.influences


def _wanted(settings: RecordingSettings, total: int) -> range:
    """Numbers of the poses to record."""
    if settings.detect_influences:
        return range(0)
    return shard_poses(*settings.shard, total) if settings.shard else range(total)


def _in_turn(
    meshes: Sequence[Before], phase: Callable[[Before], Generator[Progress, None, After]]
) -> Generator[Progress, None, list[After]]:
    """A phase of each mesh; where there are several, the stages say of which. Returns what the phases give."""
    results = []

    def keep(mesh: Before) -> Iterator[Progress]:
        results.append((yield from phase(mesh)))

    for mesh in meshes:
        with closing(keep(mesh)) as steps:
            for step in steps:
                yield step if len(meshes) == 1 else replace(step, stage=f"{step.stage} of '{mesh.name}'")
    return results


def _fit(
    mesh: MeshPlanned, settings: RecordingSettings, plan: PosePlan, player: ClipPlayer | None
) -> Generator[Progress, None, WeightsFitted]:
    """Give a mesh the weights that its linear skinning is to have."""
    if mesh.known:
        return WeightsFitted(mesh, *read_previous_weights(mesh.known, mesh.rig, settings.fit_linear))
    if not settings.fit_linear:
        check_has_weights(mesh.scene_rig, mesh.rig)
        return WeightsFitted(mesh, mesh.rig, None)
    numbers = poses_to_fit(plan.total, mesh.rig.vertex_count)
    posed = plan.poses(player, frozenset(numbers))
    evaluator = mesh.evaluator(mesh.rig)
    fitted = yield from fit_weights(mesh.rig, settings.fit_linear, posed, len(numbers), evaluator)
    return WeightsFitted(mesh, *fitted)


def _find_influences(
    mesh: WeightsFitted, settings: RecordingSettings, clips: tuple[Clip, ...], player: ClipPlayer
) -> Generator[Progress, None, InfluencesReady]:
    """Find what influences the partitions of a mesh; what moves it alone is moved, not what moves others."""
    scene_rig, channels = mesh.planned.scene_rig, mesh.planned.channels
    search = Search(
        channels,
        lambda number: sample_pose(channels, settings.seed, INFLUENCE_SEED_OFFSET + number, settings.spread),
        lambda number: _show_frame(player, clips, number),
        player.stop,
        settings.influence_poses,
        settings.influence_tolerance,
        mesh.planned.target is not None,
    )
    evaluator = TimedEvaluator(mesh.planned.evaluator(mesh.rig))
    known = mesh.planned.known
    if known and (partitions := read_previous_partitions(known, mesh.rig, settings.min_partition_vertices)):
        return InfluencesReady(mesh, partitions, evaluator)
    if known and known != mesh.planned.path:
        raise RecordingError(
            f"The influences in '{known}' are of other partitions than those of '{mesh.name}'; find them with the same "
            "rig and options (record --detect-influences)."
        )
    cut = make_merged_partitions(mesh.rig, settings.min_partition_vertices)
    target = mesh.planned.target
    if target and target.follows != POSE:
        # What depends on time does not answer when a joint is moved.
        return InfluencesReady(mesh, assume_nearby_influences(mesh.rig, cut), evaluator)
    partitions = yield from find_influences(scene_rig, mesh.rig, cut, evaluator, search)
    return InfluencesReady(mesh, partitions, evaluator)


def _record_poses(
    meshes: list[InfluencesReady], settings: RecordingSettings, plan: PosePlan, player: ClipPlayer
) -> Iterator[Progress]:
    wanted = _wanted(settings, plan.total)
    with ExitStack() as stack:
        appenders = []
        for mesh in meshes:
            info = replace(_info(mesh, settings, plan, wanted), target=plan.pose_setter.recorded)
            writer = RecordingWriter(
                mesh.fitted.planned.path,
                *(mesh.fitted.rig, mesh.partitions, info),
                *(settings.resume, settings.overwrite),
            )
            skinning = LinearSkinning(mesh.fitted.rig, mesh.partitions)
            appenders.append(Appender(mesh.evaluator, skinning, stack.enter_context(writer), plan.pose_setter))
        first, settler = min(appender.done for appender in appenders), plan.pose_setter.settler
        seconds = settler.last.seconds if settler and settler.last else None
        yield Progress("poses", first, len(wanted), estimate(meshes, len(wanted), len(wanted) - first, seconds))
        left = plan.poses(player, wanted[first:])
        # Closed before the writers: what was evaluated is kept when the recording is broken off.
        with closing(left), closing(append_poses(left, appenders)) as steps:
            for done in steps:
                yield Progress("poses", done, len(wanted), detail=str(settler.last) if settler else "")
        if plan.repeatable and settings.target.repeatability_poses and len(wanted) == plan.total:
            yield from measure_repeatability(meshes[0], plan, player, writer, settings.target.repeatability_poses)
            yield Progress("poses", len(wanted), len(wanted))


def _info(mesh: InfluencesReady, settings: RecordingSettings, plan: PosePlan, wanted: range) -> RecordingInfo:
    """What the recording of a mesh will say of itself."""
    planned = mesh.fitted.planned
    sampling = make_sampling(planned.scene_rig, settings, planned.limits)
    file, version = Path(bpy.data.filepath).name, bpy.app.version_string
    is_part = settings.shard is not None or settings.detect_influences
    shard = Shard(wanted.start, plan.total) if is_part else None
    info = RecordingInfo(len(wanted), 0, file, planned.name, version, sampling, mesh.fitted.fit, shard)
    if planned.known and planned.known != planned.path:
        check_influences_match(planned.known, mesh.fitted.rig, info)
    return info


def _show_frame(player: ClipPlayer, clips: tuple[Clip, ...], number: int) -> None:
    """Pose the rig as on one of the frames of some clips, far apart for numbers that follow each other."""
    frames = [(clip, frame) for clip in clips for frame in clip.frames]
    player.show(*frames[int(number * GOLDEN_RATIO * len(frames)) % len(frames)])
