# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks before a recording that a target moves with its rig."""

from collections.abc import Iterator
from contextlib import closing

import numpy as np

from ..core.errors import RigError
from ..core.mathematics.partition import GOLDEN_RATIO
from ..core.mathematics.skinning import LinearSkinning
from ..core.progress import Progress
from ..core.recording.target import SIMULATION
from ..poses.clip_player import ClipPlayer
from .pose_plan import PosePlan
from .recorded_mesh import RecordedMesh

MAX_CHECKED_POSES = 20
MIN_RIG_MOTION_RATIO, MAX_STILL_TARGET_RATIO = 0.02, 1e-5
"""Ratios of the rig's size. A target does not follow the rig if it moves by less than the second ratio while the rig
moves by more than the first ratio."""


def check_target_moves(mesh: RecordedMesh, plan: PosePlan, player: ClipPlayer) -> Iterator[Progress]:
    """Check that a target moves in poses in which the rig moves.

    A simulation is checked in its first frames, other targets in poses that are far apart. Poses that are held settle,
    so the check also measures how long settling takes.

    Yields:
        Progress of the stage "target".

    Raises:
        RigError: the target does not move.
    """
    evaluator, skinning = mesh.make_evaluator(), LinearSkinning(mesh.rig)
    is_simulation = plan.pose_setter.target.follows == SIMULATION
    spread_indices = sorted(
        {int(number * GOLDEN_RATIO * plan.total) % plan.total for number in range(MAX_CHECKED_POSES)}
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
            if (
                target_motion > MAX_STILL_TARGET_RATIO * mesh.rig.size
                and rig_motion > MIN_RIG_MOTION_RATIO * mesh.rig.size
            ):
                break
            if is_simulation and rig_motion > 10 * MIN_RIG_MOTION_RATIO * mesh.rig.size:
                break
    player.stop()
    if rig_motion > MIN_RIG_MOTION_RATIO * mesh.rig.size and target_motion <= MAX_STILL_TARGET_RATIO * mesh.rig.size:
        raise RigError(
            f"The target '{plan.pose_setter.target.name}' does not move while '{mesh.name}' does, by "
            f"{_format_mm(mesh, rig_motion)}; look whether its modifiers are on and its cache is that of this action, "
            "or choose another target."
        )


def _format_mm(mesh: RecordedMesh, units: float) -> str:
    return f"{units * mesh.rig.metres_per_unit * 1000:.0f} mm"
