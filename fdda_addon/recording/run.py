# SPDX-License-Identifier: GPL-3.0-or-later
"""Records meshes of one armature in the same poses, each into its own folder."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, nullcontext
from dataclasses import replace
from pathlib import Path

import bpy

from ..core.errors import RecordingError, RigError
from ..core.progress import Progress
from ..core.recording.estimate import Estimate, check_disk_space, recording_bytes
from ..core.recording.folder_check import check_recordable
from ..core.recording.index import ALONE, RecordingInfo, Source
from ..core.recording.target import POSE
from ..core.recording.writer import RecordingWriter
from ..poses.clip import find_clips
from ..rig.dependencies import deforming_mesh_objects, read_dependencies
from ..rig.modifier_stack import check_evaluable, read_stack
from ..rig.reading import PoseEvaluator
from ..rig.target_poses import make_pose_setter
from ..rig.temporary_rig_state import temporary_rig_states
from ..rig.time_inputs import check_time_inputs
from ..rig.unread_bones import describe_bones
from ..scene.scene_rig import SceneRig, check_full_rig
from .alone_poses import AlonePosePlan, plan_alone_poses
from .appender import PoseAppender
from .first_checks import check_follows_pose, check_saturation, check_seams, check_target_moves
from .plan import RecordedMesh, RecordingSettings, find_actions, listed_controls, make_sampling, read_sampled_rig
from .pose_plan import PosePlan
from .reference_joints import find_fixed_joints, find_references
from .repeatability import measure_repeatability

MISSING_WEIGHTS = (
    "'{}' has no skin weights on deforming bones, so its training needs fitted ones: --fit-linear smooth, or Base "
    "Skinning in the sidebar."
)


def record(scene_rig: SceneRig, path: Path, settings: RecordingSettings) -> Iterator[Progress]:
    """Record one mesh, as `record_meshes` does."""
    return record_meshes([(scene_rig, path)], settings)


def record_meshes(rigs: Sequence[tuple[SceneRig, Path]], settings: RecordingSettings) -> Iterator[Progress]:
    """Record meshes on one armature while the generator is iterated; each pose is evaluated once for all of them.

    The scene is restored when the generator ends, is closed, or raises.

    Args:
        rigs: each mesh, and the folder of its recording.
        settings: settings of the recording.

    Yields:
        Progress of the stage "poses", with a target also of "target" before and "repeatability" after it. The first
        progress of "poses" has a note with the estimated time and disk space.

    Raises:
        RigError: a rig cannot be recorded, or the meshes follow different armatures.
        RecordingError: a folder has a recording already, or the recording to resume differs.
        OutputError: a folder cannot be written, or the disk has too little space.
    """
    scene_rigs, first_rig = [scene_rig for scene_rig, _ in rigs], rigs[0][0]
    for other_rig in scene_rigs:
        if other_rig.armature_object != first_rig.armature_object:
            raise RigError(
                f"'{first_rig.mesh_object.name}' follows the armature '{first_rig.armature_object.name}' and "
                f"'{other_rig.mesh_object.name}' follows '{other_rig.armature_object.name}'; record the meshes of each "
                "armature by themselves, with --object."
            )
    clips = find_clips(scene_rigs, settings.actions, settings.strips, settings.mirror)
    if settings.mirror and not clips:
        raise RecordingError("There is nothing to mirror: no action and no strip; give --action or --strip.")
    if settings.target.name and len(rigs) > 1:
        raise RecordingError("A target belongs to one mesh; record the meshes one by one, each with its target.")
    sampled_rigs, notes = [], []
    for (scene_rig, path), controls in zip(rigs, _split_controls(scene_rigs, settings), strict=True):
        check_full_rig(scene_rig.mesh_object)
        stack = check_evaluable(scene_rig)
        rig, channels = read_sampled_rig(scene_rig, replace(settings, controls=controls))
        sampled_rigs.append((scene_rig, rig, channels))
        notes.append([] if rig.has_weights else [MISSING_WEIGHTS.format(scene_rig.mesh_object.name)])
        if not settings.target.name:
            notes[-1].append(check_time_inputs(scene_rig, rig.controls, stack, find_actions(settings)))
        check_recordable(path, settings.resume, settings.overwrite)
    pose_setter = make_pose_setter(first_rig, settings.target, clips, settings.poses, sampled_rigs[0][1].controls)
    plan = PosePlan([(scene_rig, channels) for scene_rig, _, channels in sampled_rigs], settings, clips, pose_setter)
    if plan.total < 1:
        raise RecordingError("There is nothing to record: 0 poses and no action; give --poses or --action.")
    target = pose_setter.target
    meshes = [
        RecordedMesh(scene_rig, rig, path, channels, PoseEvaluator(scene_rig, rig, target))
        for (scene_rig, rig, channels), (_, path) in zip(sampled_rigs, rigs, strict=True)
    ]
    check_disk_space([(mesh.path, recording_bytes(mesh.rig, plan.total)) for mesh in meshes])
    with target.prepared() if target else nullcontext():
        for indices in _group_into_passes(scene_rigs):
            posed_rigs = [sampled_rigs[index] for index in indices]
            other_rigs = [posed_rig for posed_rig in sampled_rigs if posed_rig not in posed_rigs]
            with temporary_rig_states(posed_rigs, clips, other_rigs) as player:
                recorded, seconds_per_pose = [meshes[index] for index in indices], None
                if target:
                    yield from check_target_moves(recorded[0], plan, player)
                # A target that depends on time does not follow a moved joint at once.
                follows_pose = not target or target.follows == POSE
                if follows_pose:
                    seconds_per_pose = check_follows_pose(recorded, plan, player)
                alone_plans: list[AlonePosePlan | None] = [None] * len(recorded)
                for number, mesh in enumerate(recorded):
                    if follows_pose:
                        notes[indices[number]] += [check_seams(mesh, plan, player), check_saturation(mesh)]
                    for note in filter(None, notes[indices[number]]):
                        yield Progress("poses", 0, plan.total, note)
                    fixed_joints = find_fixed_joints(mesh.scene_rig)
                    mesh.rig = find_references(mesh.scene_rig, mesh.rig, fixed_joints, plan, player)
                    if follows_pose:
                        alone_plans[number] = plan_alone_poses(
                            mesh.scene_rig, mesh.rig, mesh.channels, settings, clips, player, target is not None
                        )
                with ExitStack() as stack:
                    appenders = []
                    for index, mesh, alone in zip(indices, recorded, alone_plans, strict=True):
                        info = _make_info(mesh, settings, plan, plan.channels_of_mesh(index), alone)
                        options = settings.resume, settings.overwrite
                        writer = stack.enter_context(RecordingWriter(mesh.path, mesh.rig, info, *options))
                        appender = PoseAppender(mesh.evaluator, writer, mesh.rig.vertex_count, pose_setter)
                        appenders.append((appender, writer))
                    # The appenders end before the writers, so that an interrupted recording keeps the evaluated poses.
                    for appender, _ in appenders:
                        stack.enter_context(appender)
                    total = plan.total + sum(alone.description.poses for alone in alone_plans if alone)
                    first_pose = min(plan.total, *(appender.pose_count for appender, _ in appenders))
                    done = first_pose + sum(max(0, appender.pose_count - plan.total) for appender, _ in appenders)
                    for _, writer in appenders:
                        if writer.note:
                            yield Progress("poses", done, total, writer.note)
                    seconds = pose_setter.seconds_per_pose or seconds_per_pose
                    remaining = Estimate(
                        total - done,
                        sum(mesh.rig.vertex_count for mesh in recorded),
                        sum(recording_bytes(writer.rig, writer.info.poses) for _, writer in appenders),
                        seconds and seconds * (total - done),
                    )
                    yield Progress("poses", done, total, remaining.sentence() if done < total else "")
                    with closing(plan.show_poses(player, range(first_pose, plan.total))) as poses:
                        for pose_index in poses:
                            for appender, _ in appenders:
                                if appender.pose_count == pose_index:
                                    appender.append_current_pose()
                            done += 1
                            yield Progress("poses", done, total, detail=pose_setter.rest_description)
                    player.stop()
                    for (appender, _), alone in zip(appenders, alone_plans, strict=True):
                        if alone:
                            player.restore_numbers()
                            with closing(alone.show_poses(appender.pose_count - plan.total)) as poses:
                                for _ in poses:
                                    appender.append_current_pose()
                                    done += 1
                                    yield Progress("poses", done, total)
                    if plan.repeatable_poses and settings.target.repeatability_poses:
                        appender.flush()
                        count = settings.target.repeatability_poses
                        yield from measure_repeatability(recorded[0].evaluator, plan, player, writer, count)
                        yield Progress("poses", total, total)


def _split_controls(rigs: Sequence[SceneRig], settings: RecordingSettings) -> list[tuple[str, ...]]:
    """Return for each mesh the controls of the settings that it has.

    Raises:
        RigError: there is a control that no mesh has.
    """
    if len(rigs) == 1:
        return [settings.controls]
    controls_by_mesh: list[list[str]] = [[] for _ in rigs]
    for text in settings.controls:
        errors = []
        for scene_rig, mesh_controls in zip(rigs, controls_by_mesh, strict=True):
            try:
                listed_controls(scene_rig, replace(settings, controls=(text,)))
                mesh_controls.append(text)
            except RigError as error:
                errors.append(error)
        if len(errors) == len(rigs):
            raise errors[0]
    return [tuple(mesh_controls) for mesh_controls in controls_by_mesh]


def _group_into_passes(rigs: Sequence[SceneRig]) -> list[list[int]]:
    """Group the indices of meshes that can be evaluated together.

    Downstream modifiers are disabled while a mesh is evaluated. But another mesh may read the mesh with these
    modifiers, as a shrinkwrapped sleeve reads a subdivided body. Such a mesh gets a pass of its own.
    """
    read_objects = {mesh_object for scene_rig in rigs for mesh_object in deforming_mesh_objects(scene_rig)}
    separate_indices = [
        index
        for index, rig in enumerate(rigs)
        if rig.mesh_object in read_objects and read_stack(rig.mesh_object).downstream
    ]
    common_indices = [index for index in range(len(rigs)) if index not in separate_indices]
    return [indices for indices in (common_indices, *([index] for index in separate_indices)) if indices]


def _make_info(
    mesh: RecordedMesh, settings: RecordingSettings, plan: PosePlan, limits: tuple, alone: AlonePosePlan | None
) -> RecordingInfo:
    """Make the info of the recording of a mesh; `limits` are its channels and those that other meshes share."""
    sampling, alone_poses = make_sampling(mesh.scene_rig, settings, limits), alone.description if alone else None
    if alone_poses:
        sampling = replace(sampling, sources=(*sampling.sources, Source(ALONE, alone_poses.poses)))
    # Any joint may move a target.
    dependencies = (
        mesh.rig.joint_names
        if settings.target.name
        else read_dependencies(mesh.scene_rig, find_actions(settings)).bones
    )
    return RecordingInfo(
        sum(source.poses for source in sampling.sources),
        0,
        Path(bpy.data.filepath).name,
        bpy.app.version_string,
        sampling,
        describe_bones(mesh.scene_rig, mesh.rig, dependencies, find_fixed_joints(mesh.scene_rig)),
        plan.pose_setter.recorded_target,
        alone=alone_poses,
    )
