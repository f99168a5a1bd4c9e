# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks of a rig before its first pose is recorded: the target, the time of a pose, and changes with the frame."""

import time
from collections.abc import Iterator
from contextlib import closing

import bpy
import numpy as np

from ..core.errors import RigError
from ..core.mathematics.features import FLOAT32_ROUNDING_RATIO
from ..core.mathematics.partition import GOLDEN_RATIO, INFLUENCE_TOLERANCE
from ..core.mathematics.skinning import LinearSkinning
from ..core.progress import Progress
from ..core.recording.index import SIMULATION
from ..poses.clip_player import ClipPlayer
from ..rig.reading import PoseEvaluator
from ..scene.armature import clear_pose
from .pose_plan import PosePlan

MAX_TARGET_POSES, TIMED_POSES = 20, 12
"""Numbers of poses: in which the motion of a target is compared, and that are timed."""
MIN_RIG_MOTION_RATIO, MAX_STILL_TARGET_RATIO = 0.02, 1e-5
"""Ratios of the rig's size. A target does not follow the rig if it moves by less than the second ratio while the rig
moves by more than the first ratio."""
POSE_TOLERANCE = 1e-5
"""Largest difference between matrices and controls of poses that count as equal (no unit, or mesh units)."""


def check_target_moves(evaluator: PoseEvaluator, plan: PosePlan, player: ClipPlayer) -> Iterator[Progress]:
    """Check that a target moves in poses in which the rig moves.

    A simulation is checked in its first frames, other targets in poses that are far apart. Poses that are held settle,
    so the check also measures how long settling takes. The motion of a rig without skin weights is unknown.

    Yields:
        Progress of the stage "target".

    Raises:
        RigError: the target does not move.
    """
    if not evaluator.rig.has_weights:
        return
    rig, size, target = evaluator.rig, evaluator.rig.size, plan.pose_setter.target
    skinning, is_simulation = LinearSkinning(rig), target.follows == SIMULATION
    spread_indices = sorted(
        {int(number * GOLDEN_RATIO * plan.total) % plan.total for number in range(MAX_TARGET_POSES)}
    )
    pose_indices = (
        range(min(plan.total, 2 if plan.pose_setter.is_settling else plan.total)) if is_simulation else spread_indices
    )
    first_positions, rig_motion, target_motion = None, 0.0, 0.0
    with closing(plan.show_poses(player, pose_indices)) as poses:
        for checked_count, _ in enumerate(poses, 1):
            pose_matrices, positions, _ = evaluator.evaluate()
            skinned_positions = skinning.positions(pose_matrices[None])[0]
            if first_positions is None:
                first_positions = skinned_positions, positions
            rig_motion = max(rig_motion, float(np.abs(skinned_positions - first_positions[0]).max()))
            target_motion = max(target_motion, float(np.abs(positions - first_positions[1]).max()))
            yield Progress("target", min(checked_count, len(pose_indices)), len(pose_indices))
            if target_motion > MAX_STILL_TARGET_RATIO * size and rig_motion > MIN_RIG_MOTION_RATIO * size:
                break
            if is_simulation and rig_motion > 10 * MIN_RIG_MOTION_RATIO * size:
                break
    player.stop()
    if rig_motion > MIN_RIG_MOTION_RATIO * size and target_motion <= MAX_STILL_TARGET_RATIO * size:
        raise RigError(
            f"The target '{target.name}' does not move while '{evaluator.scene_rig.mesh_object.name}' does, by "
            f"{rig_motion * rig.metres_per_unit * 1000:.0f} mm; look whether its modifiers are on and its cache "
            "is that of this action, or choose another target."
        )


def check_follows_pose(evaluator: PoseEvaluator, plan: PosePlan, player: ClipPlayer) -> float:
    """Check that the surface of a rig does not change between frames while pose and controls are the same.

    Two poses of the plan are held in the first, middle and last frame of the scene. Poses that change with the frame
    are skipped.

    Args:
        evaluator: evaluates the rig, prepared by `temporary_rig_state`.
        plan: plan of the poses.
        player: player of the clips of the plan.

    Returns:
        The mean time of an evaluation, seconds.

    Raises:
        RigError: the surface changes between frames, and pose matrices and controls do not.
    """
    scene, start_time, evaluation_count = bpy.context.scene, time.perf_counter(), 0
    frame, subframe, rig = scene.frame_current, scene.frame_subframe, evaluator.rig
    places = rig.rest_positions.ravel(), evaluator.scene_rig.mesh_object.matrix_world.translation
    extent = float(np.abs(np.concatenate(places)).max())
    max_distance = max(INFLUENCE_TOLERANCE * rig.size, 4 * FLOAT32_ROUNDING_RATIO * extent)
    other_frames = {scene.frame_start, (scene.frame_start + scene.frame_end) // 2, scene.frame_end} - {frame}
    try:
        for pose_index in {plan.total // 3, plan.total - 1}:
            with closing(plan.show_poses(player, {pose_index})) as poses:
                next(poses)
                clip_frame, first_evaluation = player.current_clip_frame, None
                for checked_frame in (frame, *sorted(other_frames)):
                    player.set_clip_frame(clip_frame, checked_frame)
                    evaluation = evaluator.evaluate()
                    evaluation_count += 1
                    first_evaluation = first_evaluation or evaluation
                    tolerances = {"rtol": POSE_TOLERANCE, "atol": POSE_TOLERANCE}
                    if not all(np.allclose(first_evaluation[i], evaluation[i], **tolerances) for i in (0, 2)):
                        continue
                    distances = np.linalg.norm(first_evaluation[1] - evaluation[1], axis=1)
                    if distances.max() > max_distance:
                        slices = zip(evaluator.scene_rig.mesh_objects, rig.mesh_slices, strict=True)
                        name = next(o.name for o, part in slices if distances.argmax() < part.stop)
                        raise RigError(
                            f"The surface of '{name}' differs by {distances.max() * rig.metres_per_unit * 1000:.2g} mm "
                            f"between frames {frame} and {checked_frame} in the same pose, so it does not follow from "
                            "the pose; find the keys, drivers, Geometry Nodes or constraint targets that depend on the "
                            "frame, and make them controls or switch them off."
                        )
    finally:
        player.stop()
        player.reset_pose()
        scene.frame_set(frame, subframe=subframe)
    return (time.perf_counter() - start_time) / evaluation_count


def measure_seconds_per_pose(evaluator: PoseEvaluator, plan: PosePlan, player: ClipPlayer) -> float:
    """Return the median time of the first random poses."""
    times = [time.perf_counter()]
    with closing(plan.show_poses(player, range(min(plan.random_count, TIMED_POSES)))) as poses:
        for _ in poses:
            evaluator.evaluate()
            times.append(time.perf_counter())
    player.stop()
    clear_pose(evaluator.scene_rig.armature_object)
    player.restore_numbers()
    return float(np.median(np.diff(times)))
