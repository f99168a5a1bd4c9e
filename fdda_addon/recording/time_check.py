# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks that the surface depends on the pose alone: the same pose must have the same surface in several frames."""

from collections.abc import Sequence
from contextlib import closing

import bpy
import numpy as np

from ..core.errors import RigError
from ..core.mathematics.features import FLOAT32_ROUNDING_RATIO
from ..core.mathematics.partition import INFLUENCE_TOLERANCE
from ..core.recording.target import POSE
from ..poses.clip_player import ClipPlayer
from .pose_plan import PosePlan
from .recorded_mesh import RecordedMesh

POSE_TOLERANCE = 1e-5
"""Largest difference between matrices and controls of poses that count as equal (no unit, or mesh units)."""


def check_follows_pose(meshes: Sequence[RecordedMesh], plan: PosePlan, player: ClipPlayer) -> None:
    """Check that the surfaces of meshes do not change between frames while pose and controls are the same.

    Two poses of the plan are held in the first, middle and last frame of the scene. Targets that depend on time are
    skipped, and so are poses that change with the frame.

    Args:
        meshes: the meshes that are evaluated together, prepared by `temporary_rig_states`.
        plan: plan of the poses.
        player: player of the clips of the plan.

    Raises:
        RigError: a surface differs between frames.
    """
    target = plan.pose_setter.target
    if target and target.follows != POSE:
        return
    scene = bpy.context.scene
    frame, subframe = scene.frame_current, scene.frame_subframe
    other_frames = {scene.frame_start, (scene.frame_start + scene.frame_end) // 2, scene.frame_end} - {frame}
    evaluators = [mesh.make_evaluator() for mesh in meshes]
    try:
        for pose_index in {plan.total // 3, plan.total - 1}:
            with closing(plan.show_poses(player, {pose_index})) as poses:
                next(poses)
                clip_frame = player.current_clip_frame
                player.set_clip_frame(clip_frame, frame)
                first_evaluations = [evaluator.evaluate() for evaluator in evaluators]
                for other_frame in sorted(other_frames):
                    player.set_clip_frame(clip_frame, other_frame)
                    for mesh, evaluator, first_evaluation in zip(meshes, evaluators, first_evaluations, strict=True):
                        _compare_surfaces(mesh, (frame, other_frame), first_evaluation, evaluator.evaluate())
    finally:
        player.stop()
        player.reset_pose()
        scene.frame_set(frame, subframe=subframe)


def _compare_surfaces(
    mesh: RecordedMesh,
    frames: tuple[int, int],
    first_evaluation: Sequence[np.ndarray],
    other_evaluation: Sequence[np.ndarray],
) -> None:
    (pose_matrices, positions, controls), (other_pose_matrices, other_positions, other_controls) = (
        first_evaluation,
        other_evaluation,
    )
    if not all(
        np.allclose(*pair, rtol=POSE_TOLERANCE, atol=POSE_TOLERANCE)
        for pair in ((pose_matrices, other_pose_matrices), (controls, other_controls))
    ):
        return
    largest_difference = float(np.linalg.norm(positions - other_positions, axis=1).max())
    mesh_object = mesh.scene_rig.mesh_object
    extent = max(float(np.abs(mesh.rig.rest_positions).max()), *map(abs, mesh_object.matrix_world.translation))
    if largest_difference > max(INFLUENCE_TOLERANCE * mesh.rig.size, 4 * FLOAT32_ROUNDING_RATIO * extent):
        raise RigError(
            f"The surface of '{mesh.name}' differs by {largest_difference * mesh.rig.metres_per_unit * 1000:.2g} mm "
            f"between frames {frames[0]} and {frames[1]} in the same pose, so it does not follow from the pose; find "
            "the keys, drivers, Geometry Nodes or constraint targets that depend on the frame, and make them controls "
            "or switch them off."
        )
