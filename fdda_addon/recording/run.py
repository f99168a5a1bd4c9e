# SPDX-License-Identifier: GPL-3.0-or-later
"""Records rigs: runs the phases of a recording."""

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import bpy

from ..core.errors import RecordingError
from ..core.key_joints import add_influences
from ..core.partition import GOLDEN_RATIO, assume_nearby_influences, make_merged_partitions
from ..core.progress import Progress
from ..core.recording.estimate import check_disk_space, recording_bytes
from ..core.recording.folder_check import check_recordable
from ..core.recording.index import INDEX_NAME, RecordingInfo
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
from .appender import PoseAppender, append_poses
from .influence_trials import InfluenceSearch
from .influences import detect_influences
from .mesh_group import common_armature, group_into_passes, split_controls
from .phases import InfluencesReady, MeshPlanned, TimedEvaluator, WeightsFitted, describe_estimate
from .plan import RecordingSettings, find_actions, make_pose_sampler, make_sampling, read_sampled_rig
from .pose_plan import PosePlan
from .previous_recording import check_influences_match, read_previous_partitions, read_previous_weights
from .repeatability import measure_repeatability
from .target_check import check_target_moves
from .time_check import check_follows_pose
from .weight_fitting import check_has_weights, fit_weights, make_fit_request

PreviousState, NextState = TypeVar("PreviousState", MeshPlanned, WeightsFitted), TypeVar("NextState")
INFLUENCE_SEED_OFFSET = 1 << 32
"""Offset of the indices of random poses for the detection of influences, larger than any pose index of a recording."""


def record(scene_rig: SceneRig, path: Path, settings: RecordingSettings) -> Iterator[Progress]:
    """Record a rig while the generator is iterated.

    The scene is restored when the generator ends, is closed, or raises.

    Args:
        scene_rig: the rig.
        path: folder of the recording.
        settings: settings of the recording.

    Yields:
        Progress of the stages "influences" and "poses". If weights are fitted, the stages "poses to fit" and "fit" come
        first. The first progress of "poses" has a note with the estimated time and disk space.

    Raises:
        RigError: the rig cannot be recorded.
        TrainingError: the trainer's Python cannot fit the weights.
        RecordingError: the folder has a recording already, or the recording to resume differs.
        OutputError: the folder cannot be written, or the disk has too little space.
    """
    return record_meshes([(scene_rig, path)], settings)


def record_meshes(rigs: Sequence[tuple[SceneRig, Path]], settings: RecordingSettings) -> Iterator[Progress]:
    """Record several meshes on one armature, each into its own folder, as `record` does.

    The meshes share the poses, and each pose is evaluated once for all meshes of a pass (`group_into_passes`).

    Raises:
        RigError: as `record`, or the meshes follow different armatures.
    """
    meshes = [scene_rig for scene_rig, _ in rigs]
    clips = find_clips(common_armature(meshes), settings.actions, settings.strips, settings.mirror)
    planned, plan = _plan_recordings(rigs, settings, clips)
    target = plan.pose_setter.target
    with target.prepared() if target else nullcontext():
        yield from _record_planned(planned, settings, clips, plan)


def _record_planned(
    planned: list[MeshPlanned], settings: RecordingSettings, clips: tuple[Clip, ...], plan: PosePlan
) -> Iterator[Progress]:
    scene_rigs, posed_rigs = [mesh.scene_rig for mesh in planned], [mesh.posed_rig for mesh in planned]
    with temporary_rig_states(posed_rigs, clips) if settings.fits_weights else nullcontext() as player:
        fitted_meshes = yield from _run_phase(planned, lambda mesh: _fit_mesh_weights(mesh, settings, plan, player))
    for mesh_indices in group_into_passes(scene_rigs):
        meshes_in_pass = [fitted_meshes[index] for index in mesh_indices]
        other_rigs = [mesh for index, mesh in enumerate(posed_rigs) if index not in mesh_indices]
        with temporary_rig_states([posed_rigs[index] for index in mesh_indices], clips, other_rigs) as player:
            if plan.pose_setter.target:
                yield from check_target_moves(meshes_in_pass[0], plan, player)
            check_follows_pose(meshes_in_pass, plan, player)
            ready_meshes = yield from _run_phase(
                meshes_in_pass, lambda mesh: _find_influences(mesh, settings, clips, player)
            )
            yield from _record_poses(ready_meshes, settings, plan, player)


def _plan_recordings(
    rigs: Sequence[tuple[SceneRig, Path]], settings: RecordingSettings, clips: tuple[Clip, ...]
) -> tuple[list[MeshPlanned], PosePlan]:
    """Plan the recordings of meshes and their shared poses, and raise all errors that can be found in advance."""
    if settings.mirror and not clips:
        raise RecordingError("There is nothing to mirror: no action and no strip; give --action or --strip.")
    scene_rigs = [scene_rig for scene_rig, _ in rigs]
    controls = [settings.controls] if len(rigs) == 1 else split_controls(scene_rigs, settings)
    if settings.target.name and len(rigs) > 1:
        raise RecordingError("A target belongs to one mesh; record the meshes one by one, each with its target.")
    rigs_with_channels = []
    for (scene_rig, path), mesh_controls in zip(rigs, controls, strict=True):
        stack = check_evaluable(scene_rig)
        rigs_with_channels.append(read_sampled_rig(scene_rig, replace(settings, controls=mesh_controls)))
        if not settings.target.name:
            check_time_inputs(scene_rig, rigs_with_channels[-1][0].controls, stack, find_actions(settings))
        check_recordable(path, settings.resume, settings.overwrite)
    meshes_with_channels = [
        (scene_rig, channels) for scene_rig, (_, channels) in zip(scene_rigs, rigs_with_channels, strict=True)
    ]
    target_controls = rigs_with_channels[0][0].controls
    pose_setter = make_pose_setter(scene_rigs[0], settings.target, clips, settings.poses, target_controls)
    plan = PosePlan(meshes_with_channels, settings, clips, pose_setter)
    if plan.total < 1:
        raise RecordingError("There is nothing to record: 0 poses and no action; give --poses or --action.")
    pose_count = len(_pose_indices(settings, plan.total))
    check_disk_space(
        [(path, recording_bytes(rig, pose_count)) for (_, path), (rig, _) in zip(rigs, rigs_with_channels, strict=True)]
    )
    previous_paths = [_previous_recording(path, settings, len(rigs) > 1) for _, path in rigs]
    planned = [
        MeshPlanned(
            scene_rig, rig, path, channels, plan.channels_of_mesh(index), previous_paths[index], pose_setter.target
        )
        for index, ((scene_rig, path), (rig, channels)) in enumerate(zip(rigs, rigs_with_channels, strict=True))
    ]
    return planned, plan


def _previous_recording(path: Path, settings: RecordingSettings, is_one_of_several: bool) -> Path | None:
    """Return the recording whose weights and influences the recording at `path` reuses; None if there is none."""
    if settings.resume and (path / INDEX_NAME).exists():
        return path
    if settings.influences is None:
        return None
    return settings.influences / path.name if is_one_of_several else settings.influences


def _pose_indices(settings: RecordingSettings, total: int) -> range:
    """Return the indices of the poses to record."""
    if settings.detect_influences:
        return range(0)
    return shard_poses(*settings.shard, total) if settings.shard else range(total)


def _run_phase(
    meshes: Sequence[PreviousState], phase: Callable[[PreviousState], Generator[Progress, None, NextState]]
) -> Generator[Progress, None, list[NextState]]:
    """Run a phase for each mesh, and return the results. The stages of several meshes include the mesh's name."""
    results = []

    def collect_result(mesh: PreviousState) -> Iterator[Progress]:
        results.append((yield from phase(mesh)))

    for mesh in meshes:
        with closing(collect_result(mesh)) as steps:
            for step in steps:
                yield step if len(meshes) == 1 else replace(step, stage=f"{step.stage} of '{mesh.name}'")
    return results


def _fit_mesh_weights(
    mesh: MeshPlanned, settings: RecordingSettings, plan: PosePlan, player: ClipPlayer | None
) -> Generator[Progress, None, WeightsFitted]:
    """Fit the skin weights of a mesh, read previously fitted weights, or keep the weights of the rig."""
    if mesh.previous_path:
        weights = read_previous_weights(mesh.previous_path, mesh.scene_rig, mesh.rig, settings)
        return WeightsFitted(mesh, weights.rig, weights.fit)
    if not settings.fits_weights:
        check_has_weights(mesh.scene_rig, mesh.rig)
        return WeightsFitted(mesh, mesh.rig, None)
    request = make_fit_request(mesh.scene_rig, mesh.rig, settings, mesh.channels, plan.total)
    shown_poses = plan.show_poses(player, frozenset(request.poses))
    weights = yield from fit_weights(mesh.scene_rig, mesh.rig, request, shown_poses, mesh.evaluator(mesh.rig))
    return WeightsFitted(mesh, weights.rig, weights.fit, weights.needed_inputs)


def _find_influences(
    mesh: WeightsFitted, settings: RecordingSettings, clips: tuple[Clip, ...], player: ClipPlayer
) -> Generator[Progress, None, InfluencesReady]:
    """Read previous influences on the partitions of a mesh, or detect them with the channels of this mesh alone."""
    scene_rig, channels = mesh.planned.scene_rig, mesh.planned.channels
    sampler = make_pose_sampler(scene_rig, settings)
    search = InfluenceSearch(
        channels,
        lambda index: sampler.draw_pose(channels, INFLUENCE_SEED_OFFSET + index),
        lambda index: _show_frame(player, clips, index),
        player.stop,
        settings.influence_poses,
        settings.influence_tolerance,
        mesh.planned.target is not None or mesh.needed_inputs is not None,
    )
    evaluator = TimedEvaluator(mesh.planned.evaluator(mesh.rig))
    previous_path = mesh.planned.previous_path
    if previous_path and (
        partitions := read_previous_partitions(previous_path, mesh.rig, settings.min_partition_vertices)
    ):
        return InfluencesReady(mesh, partitions, evaluator)
    if previous_path and previous_path != mesh.planned.path:
        raise RecordingError(
            f"The influences in '{previous_path}' are of other partitions than those of '{mesh.name}'; find them with "
            "the same rig and options (record --detect-influences)."
        )
    partitions_without_influences = make_merged_partitions(mesh.rig, settings.min_partition_vertices)
    target = mesh.planned.target
    if target and target.follows != POSE:
        # A target that depends on time does not follow a moved joint immediately, so influences cannot be detected.
        partitions = assume_nearby_influences(mesh.rig, partitions_without_influences)
    else:
        partitions = yield from detect_influences(scene_rig, mesh.rig, partitions_without_influences, evaluator, search)
    if mesh.needed_inputs is not None:
        partitions = add_influences(partitions, mesh.needed_inputs, len(mesh.rig.joints))
    return InfluencesReady(mesh, partitions, evaluator)


def _record_poses(
    meshes: list[InfluencesReady], settings: RecordingSettings, plan: PosePlan, player: ClipPlayer
) -> Iterator[Progress]:
    pose_indices = _pose_indices(settings, plan.total)
    with ExitStack() as stack:
        appenders = []
        for mesh in meshes:
            info = replace(_make_info(mesh, settings, plan, pose_indices), target=plan.pose_setter.recorded_target)
            writer = RecordingWriter(
                mesh.fitted.planned.path,
                *(mesh.fitted.rig, mesh.partitions, info),
                *(settings.resume, settings.overwrite),
            )
            skinning = LinearSkinning(mesh.fitted.rig, mesh.partitions)
            appenders.append(PoseAppender(mesh.evaluator, skinning, stack.enter_context(writer), plan.pose_setter))
        pose_count, settler = min(appender.pose_count for appender in appenders), plan.pose_setter.settler
        seconds_per_pose = settler.last_rest_state.seconds if settler and settler.last_rest_state else None
        yield Progress(
            "poses",
            pose_count,
            len(pose_indices),
            describe_estimate(meshes, len(pose_indices), len(pose_indices) - pose_count, seconds_per_pose),
        )
        remaining_poses = plan.show_poses(player, pose_indices[pose_count:])
        # Close the generators before the writers, so that an interrupted recording keeps the evaluated poses.
        with closing(remaining_poses), closing(append_poses(remaining_poses, appenders)) as pose_counts:
            for recorded_count in pose_counts:
                yield Progress(
                    "poses", recorded_count, len(pose_indices), detail=str(settler.last_rest_state) if settler else ""
                )
        if plan.repeatable_poses and settings.target.repeatability_poses and len(pose_indices) == plan.total:
            yield from measure_repeatability(meshes[0], plan, player, writer, settings.target.repeatability_poses)
            yield Progress("poses", len(pose_indices), len(pose_indices))


def _make_info(
    mesh: InfluencesReady, settings: RecordingSettings, plan: PosePlan, pose_indices: range
) -> RecordingInfo:
    """Make the info of the recording of a mesh."""
    planned = mesh.fitted.planned
    sampling = make_sampling(planned.scene_rig, settings, planned.limits)
    file_name, blender_version = Path(bpy.data.filepath).name, bpy.app.version_string
    is_shard = settings.shard is not None or settings.detect_influences
    shard = Shard(pose_indices.start, plan.total) if is_shard else None
    info = RecordingInfo(
        len(pose_indices), 0, file_name, planned.name, blender_version, sampling, mesh.fitted.fit, shard
    )
    if planned.previous_path and planned.previous_path != planned.path:
        check_influences_match(planned.previous_path, mesh.fitted.rig, info)
    return info


def _show_frame(player: ClipPlayer, clips: tuple[Clip, ...], index: int) -> None:
    """Show a frame of the clips; consecutive indices result in frames that are far apart."""
    frames = [(clip, frame) for clip in clips for frame in clip.frames]
    player.show(*frames[int(index * GOLDEN_RATIO * len(frames)) % len(frames)])
