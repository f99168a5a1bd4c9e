# SPDX-License-Identifier: GPL-3.0-or-later
"""Check that the surface depends on the pose alone: in several frames the same pose must show the same surface."""

from collections.abc import Sequence
from contextlib import closing

import bpy
import numpy as np

from ..core.errors import RigError
from ..core.features import FLOAT32_ROUNDING_RATIO
from ..core.partition import INFLUENCE_TOLERANCE
from ..core.recording.target import POSE
from ..poses.clip_player import ClipPlayer
from ..scene.armature import clear_pose
from .phases import WeightsFitted
from .pose_plan import PosePlan

POSE_TOLERANCE = 1e-5
"""Largest difference of matrices and controls of equal poses (no unit, or mesh units)."""


def check_follows_pose(meshes: Sequence[WeightsFitted], plan: PosePlan, player: ClipPlayer) -> None:
    """Check that the surfaces of meshes do not change between frames while pose and controls are the same.

    Two poses of the plan are held in the first, middle and last frame of the scene. Targets that depend on time are
    skipped, and so are poses that change with the frame.

    Args:
        meshes: that are evaluated together, inside of `temporary_rig_states`.
        plan: of the poses.
        player: plays its clips.

    Raises:
        RigError: a surface differs between frames.
    """
    target = plan.pose_setter.target
    if target and target.follows != POSE:
        return
    scene = bpy.context.scene
    frame, subframe = scene.frame_current, scene.frame_subframe
    others = {scene.frame_start, (scene.frame_start + scene.frame_end) // 2, scene.frame_end} - {frame}
    evaluators = [mesh.planned.evaluator(mesh.rig) for mesh in meshes]
    try:
        for number in {plan.total // 3, plan.total - 1}:
            with closing(plan.show_poses(player, {number})) as poses:
                next(poses)
                clip_frame = player.current_clip_frame
                player.set_clip_frame(clip_frame, frame)
                first = [evaluator.evaluate() for evaluator in evaluators]
                for other in sorted(others):
                    player.set_clip_frame(clip_frame, other)
                    for mesh, evaluator, before in zip(meshes, evaluators, first, strict=True):
                        _compare_surfaces(mesh, (frame, other), before, evaluator.evaluate())
    finally:
        player.stop()
        clear_pose(meshes[0].planned.scene_rig.armature_object)
        player.restore_numbers()
        scene.frame_set(frame, subframe=subframe)


def _compare_surfaces(
    mesh: WeightsFitted, frames: tuple[int, int], before: Sequence[np.ndarray], after: Sequence[np.ndarray]
) -> None:
    (pose, positions, controls), (other_pose, other_positions, other_controls) = before, after
    if not all(
        np.allclose(*pair, rtol=POSE_TOLERANCE, atol=POSE_TOLERANCE)
        for pair in ((pose, other_pose), (controls, other_controls))
    ):
        return
    largest_difference = float(np.linalg.norm(positions - other_positions, axis=1).max())
    mesh_object = mesh.planned.scene_rig.mesh_object
    extent = max(float(np.abs(mesh.rig.rest_positions).max()), *map(abs, mesh_object.matrix_world.translation))
    if largest_difference > max(INFLUENCE_TOLERANCE * mesh.rig.size, 4 * FLOAT32_ROUNDING_RATIO * extent):
        raise RigError(
            f"The surface of '{mesh.name}' differs by {largest_difference * mesh.rig.metres_per_unit * 1000:.2g} mm "
            f"between frames {frames[0]} and {frames[1]} in the same pose, so it does not follow from the pose; find "
            "the keys, drivers, Geometry Nodes or constraint targets that depend on the frame, and make them controls "
            "or switch them off."
        )
