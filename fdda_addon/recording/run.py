# SPDX-License-Identifier: GPL-3.0-or-later
"""Records the meshes of a rig in the same poses, in batches that a thread writes."""

from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import Self

import bpy
import numpy as np

from ..core.errors import RecordingError, RigError
from ..core.mathematics.metrics import distances
from ..core.progress import Progress
from ..core.recording.arrays import open_array
from ..core.recording.estimate import Estimate, check_disk_space, free_bytes, recording_bytes
from ..core.recording.folder import check_recordable
from ..core.recording.index import ALONE, POSE, RecordingInfo, Source, repeated_poses
from ..core.recording.writer import RecordingWriter
from ..core.wording import format_count
from ..poses.clip import find_clips
from ..rig.deformation import describe_bones
from ..rig.dependencies import deforming_mesh_objects, read_dependencies
from ..rig.modifier_stack import check_evaluable, read_stack
from ..rig.pose_setter import DIRECT_POSE_SETTER, PoseSetter, make_pose_setter, temporary_rig_state
from ..rig.reading import PoseEvaluator
from ..rig.time_inputs import check_time_inputs
from ..scene.scene_rig import SceneRig, check_full_rig
from .alone_poses import plan_alone_poses
from .first_checks import (
    check_follows_pose,
    check_target_moves,
    measure_seconds_per_pose,
)
from .plan import (
    RecordingSettings,
    automatic_poses,
    depends_on_time,
    find_actions,
    keep_recorded_poses,
    make_sampling,
    read_sample_selection,
    read_sampled_rig,
)
from .pose_plan import PosePlan, find_fixed_joints, find_references

MISSING_WEIGHTS = (
    "'{}' has no skin weights on deforming bones, so its training needs fitted ones: --base-skinning smooth, or Base "
    "Skinning in the sidebar."
)


BATCH_BYTES = 6 << 20
BATCH_POSES = 250
"""Largest size of a batch. Batches are small, because a crash loses those that are not written yet."""


class PoseAppender:
    """Context manager that appends the poses of one mesh to its recording.

    Attributes:
        pose_count: number of evaluated poses, including the poses that the recording had before. The recording contains
            all of them when the `with` block ends, even if it ends because a generator was closed.
    """

    def __init__(
        self,
        evaluator: PoseEvaluator,
        writer: RecordingWriter,
        vertex_count: int,
        pose_setter: PoseSetter = DIRECT_POSE_SETTER,
    ) -> None:
        self._evaluator, self._writer, self._pose_setter = evaluator, writer, pose_setter
        self.pose_count = writer.complete
        self._batch_size = max(1, min(BATCH_POSES, BATCH_BYTES // (vertex_count * 12)))
        self._pool = ThreadPoolExecutor(max_workers=1)
        self._pending_append: Future | None = None
        self._batch: list[tuple] = []

    def append_current_pose(self) -> None:
        """Evaluate the current pose, and append its batch when the batch is full."""
        self._batch.append((*self._evaluator.evaluate(), self._pose_setter.is_at_rest))
        self.pose_count += 1
        # A pose that took seconds to settle is written at once.
        if len(self._batch) == self._batch_size or self._pose_setter.is_settling:
            self._wait_for_append()
            self._pending_append = self._pool.submit(self._append, self._batch)
            self._batch = []

    def _wait_for_append(self) -> None:
        if self._pending_append is not None:
            self._pending_append.result()

    def _append(self, batch: list[tuple]) -> None:
        *arrays, are_at_rest = (np.stack(arrays) for arrays in zip(*batch, strict=True))
        unsettled_indices = np.flatnonzero(~are_at_rest).tolist()
        self._writer.append(*arrays, *([unsettled_indices] if unsettled_indices else []))

    def flush(self) -> None:
        """Append all evaluated poses."""
        self._wait_for_append()
        if self._batch:
            self._append(self._batch)
            self._batch = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, exception_type: type | None, *_: object) -> None:
        try:
            if exception_type is None or exception_type is GeneratorExit:
                self.flush()
        finally:
            self._pool.shutdown()


def record(scene_rig: SceneRig, path: Path, settings: RecordingSettings) -> Iterator[Progress]:
    """Record the meshes of a rig while the generator is iterated.

    The scene is restored when the generator ends, is closed, or raises.

    Args:
        path: folder of the recording.
        settings: settings of the recording.

    Yields:
        Progress of the stages "poses" and "influences", with a target also of "target" before and "repeatability" after
        these. The first progress of "poses" has a note with the estimated time and disk space.

    Raises:
        RigError: the rig cannot be recorded.
        RecordingError: the folder has a recording already, or the recording to resume differs.
        OutputError: the folder cannot be written, or the disk has too little space.
    """
    clips = find_clips([scene_rig], settings.actions, settings.strips, settings.mirror)
    if settings.mirror and not clips:
        raise RecordingError("There is nothing to mirror: no action and no strip; give --action or --strip.")
    if settings.target.name and scene_rig.other_meshes:
        raise RecordingError("A target belongs to one mesh; record each mesh by itself, with its target.")
    stacks = []
    for _, part in scene_rig.parts:
        check_full_rig(part.mesh_object)
        stacks.append(check_evaluable(part))
    # Raise a RigError if a mesh is deformed by another one that has downstream modifiers, which a recording disables.
    # An example is a shirt with a Surface Deform modifier on a body that a later modifier subdivides.
    for mesh_object in scene_rig.mesh_objects if scene_rig.other_meshes else ():
        for read_object in deforming_mesh_objects(scene_rig, mesh_object):
            if read_object in scene_rig.mesh_objects and (names := read_stack(read_object).downstream):
                raise RigError(
                    f"'{mesh_object.name}' follows the surface of '{read_object.name}' with its modifier '{names[0]}', "
                    f"which is off while '{read_object.name}' is recorded; switch it off in the viewport, or record "
                    f"'{mesh_object.name}' by itself."
                )
    if settings.resume:
        settings = keep_recorded_poses(settings, path)
    if settings.auto_poses and settings.target.name:
        selection, _ = read_sample_selection(scene_rig, settings)
        if depends_on_time(scene_rig, settings, selection.controls):
            settings = replace(settings, auto_poses=False)
            if clips and not settings.target.settle_frames:
                settings = replace(settings, poses=0, bones_to_pose=())
    rig, channels = read_sampled_rig(scene_rig, settings)
    notes = [] if rig.has_weights else [MISSING_WEIGHTS.format(scene_rig.mesh_object.name)]
    if not settings.target.name:
        actions = find_actions(settings)
        for mesh_object, stack in zip(scene_rig.mesh_objects, stacks, strict=True):
            notes.append(check_time_inputs(scene_rig, rig.controls, stack, actions, mesh_object))
    check_recordable(path, settings.resume, settings.overwrite)
    pose_setter = make_pose_setter(scene_rig, settings.target, clips, settings.poses, rig.controls)
    plan = PosePlan(scene_rig, channels, settings, clips, pose_setter)
    if plan.total < 1:
        raise RecordingError("There is nothing to record: 0 poses and no action; give --poses or --action.")
    target = pose_setter.target
    evaluator = PoseEvaluator(scene_rig, rig, target)
    with ExitStack() as exit_stack:
        if target:
            exit_stack.enter_context(target.prepared())
        player = exit_stack.enter_context(temporary_rig_state(scene_rig, rig, channels, clips))
        seconds_per_pose, alone = None, None
        if target:
            yield from check_target_moves(evaluator, plan, player)
        # A target that depends on time does not follow a moved joint at once.
        follows_pose = not target or target.follows == POSE
        if follows_pose:
            seconds_per_pose = check_follows_pose(evaluator, plan, player)
            if settings.auto_poses:
                seconds_per_pose = measure_seconds_per_pose(evaluator, plan, player)
                bytes_per_pose = recording_bytes(rig, 1) - recording_bytes(rig, 0)
                poses = automatic_poses(seconds_per_pose, bytes_per_pose, free_bytes(path))
                settings = replace(settings, poses=poses, auto_poses=False)
                plan = PosePlan(scene_rig, channels, settings, clips, pose_setter)
                notes.append(f"{format_count(poses, 'random pose')}, at {1000 * seconds_per_pose:.1f} ms each.")
        for note in filter(None, notes):
            yield Progress("poses", 0, plan.total, note)
        fixed_joints = find_fixed_joints(scene_rig)
        rig = find_references(scene_rig, rig, fixed_joints, plan, player)
        if follows_pose:
            alone = plan_alone_poses(scene_rig, rig, channels, settings, clips, player, target is not None)
        sampling, alone_poses = make_sampling(scene_rig, settings, channels), alone.description if alone else None
        if alone_poses:
            sampling = replace(sampling, sources=(*sampling.sources, Source(ALONE, alone_poses.poses)))
        # Any joint may move a target.
        dependencies = (
            rig.joint_names if settings.target.name else read_dependencies(scene_rig, find_actions(settings)).bones
        )
        info = RecordingInfo(
            sum(source.poses for source in sampling.sources),
            0,
            Path(bpy.data.filepath).name,
            bpy.app.version_string,
            sampling,
            describe_bones(scene_rig, rig, dependencies, fixed_joints),
            plan.pose_setter.recorded_target,
            alone=alone_poses,
        )
        check_disk_space(path, recording_bytes(rig, info.poses))
        writer = exit_stack.enter_context(RecordingWriter(path, rig, info, settings.resume, settings.overwrite))
        # The appender ends before the writer, so that an interrupted recording keeps the evaluated poses.
        appender = exit_stack.enter_context(PoseAppender(evaluator, writer, rig.vertex_count, pose_setter))
        start, alone_count = min(appender.pose_count, plan.total), len(info.alone_poses)
        if writer.note:
            yield Progress("poses", start, plan.total, writer.note)
        seconds, remaining = pose_setter.seconds_per_pose or seconds_per_pose, info.poses - appender.pose_count
        estimate = Estimate(
            remaining,
            min(remaining, alone_count),
            rig.vertex_count,
            recording_bytes(rig, info.poses),
            seconds and seconds * remaining,
        )
        yield Progress("poses", start, plan.total, estimate.sentence() if remaining else "")
        with closing(plan.show_poses(player, range(start, plan.total))) as poses:
            for _ in poses:
                appender.append_current_pose()
                yield Progress("poses", appender.pose_count, plan.total, detail=pose_setter.rest_description)
        player.stop()
        if alone:
            player.restore_numbers()
            with closing(alone.show_poses(appender.pose_count - plan.total)) as poses:
                for _ in poses:
                    appender.append_current_pose()
                    yield Progress("influences", appender.pose_count - plan.total, alone_count)
        if pose_setter.is_settling and writer.repeatability_mm is None:
            appender.flush()
            yield from measure_repeatability(evaluator, plan, writer)


def measure_repeatability(evaluator: PoseEvaluator, plan: PosePlan, writer: RecordingWriter) -> Iterator[Progress]:
    """Reach settled poses from another direction, and write the mean distance from the recorded target to the index.

    Args:
        evaluator: evaluates the target.
        plan: plan of the poses.
        writer: writer of the complete recording.

    Yields:
        Progress of the stage "repeatability".
    """
    indices = repeated_poses(plan.in_range_count, writer.unsettled)
    shape = writer.complete, writer.rig.vertex_count, 3
    recorded, means = open_array(writer.path / "positions.npy", shape, np.float32), []
    with closing(plan.show_poses_again(indices)) as shown_poses:
        for index in shown_poses:
            positions = evaluator.evaluate()[1]
            means.append(float(distances(positions, recorded[index], writer.rig.metres_per_unit).mean() * 1000))
            detail = plan.pose_setter.rest_description
            yield Progress("repeatability", len(means), len(indices), detail=detail)
    if means:
        writer.set_repeatability(round(float(np.mean(means)), 6))
