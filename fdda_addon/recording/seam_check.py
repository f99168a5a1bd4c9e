# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks before a recording that a mesh is not cut into pieces which come apart."""

from collections.abc import Iterator
from contextlib import closing

import numpy as np

from ..core.checks.seams import find_open_seams
from ..core.mathematics.skinning import LinearSkinning
from ..core.recording.target import POSE
from ..poses.clip_player import ClipPlayer
from ..rig.reading import PoseEvaluator
from ..scene.armature import clear_pose
from .pose_plan import PosePlan
from .recorded_mesh import RecordedMesh

MAX_CHECKED_POSES = 10
"""Number of poses in which the gaps of a mesh with cuts are measured."""


def check_seams(mesh: RecordedMesh, plan: PosePlan, player: ClipPlayer) -> str:
    """Return a sentence if cuts of a mesh open in poses that are far apart; empty if not.

    The rig's own skin weights show which pieces lie together, which fitted ones may not. Targets that depend on time
    are skipped, because setting their poses takes long.

    Args:
        mesh: the mesh, prepared by `temporary_rig_states`.
        plan: plan of the poses.
        player: player of the clips of the plan.
    """
    if mesh.target and mesh.target.follows != POSE:
        return ""
    rig = mesh.original_rig
    evaluator, skinning = PoseEvaluator(mesh.scene_rig, rig, mesh.target), LinearSkinning(rig)
    pose_indices = set(np.linspace(0, plan.total - 1, MAX_CHECKED_POSES).round().astype(int).tolist())

    def evaluate_residuals() -> Iterator[np.ndarray]:
        with closing(plan.show_poses(player, pose_indices)) as poses:
            for _ in poses:
                pose_matrices, positions, _ = evaluator.evaluate()
                yield skinning.local_residuals(pose_matrices[None], positions[None])[0]

    with closing(evaluate_residuals()) as residuals:
        warnings = find_open_seams(rig, residuals)
    player.stop()
    clear_pose(mesh.scene_rig.armature_object)
    player.restore_numbers()
    return f"{mesh.name}: {warnings[0]}" if warnings else ""
