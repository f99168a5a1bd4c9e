# SPDX-License-Identifier: GPL-3.0-or-later
"""Check before a recording that a target follows its rig."""

from collections.abc import Iterator
from contextlib import closing

import numpy as np

from ..core.errors import RigError
from ..core.partition import GOLDEN_RATIO
from ..core.progress import Progress
from ..core.recording.target import SIMULATION
from ..core.skinning import LinearSkinning
from ..poses.clip_player import ClipPlayer
from .phases import WeightsFitted
from .pose_plan import PosePlan

MAX_CHECKED_POSES = 20
MIN_RIG_MOTION_RATIO, MAX_STILL_TARGET_RATIO = 0.02, 1e-5
"""Ratios of the rig's size: a target that moves by less than the second, while the rig moves by more than the first,
does not follow the rig."""


def check_target_moves(mesh: WeightsFitted, plan: PosePlan, player: ClipPlayer) -> Iterator[Progress]:
    """Check that a target moves in poses in which the rig moves.

    A simulation is checked in its first frames, other targets in poses that are far apart. Poses that are held come to
    rest, which also measures their time.

    Yields:
        Progress of the stage "target".

    Raises:
        RigError: the target does not move.
    """
    evaluator, skinning = mesh.planned.evaluator(mesh.rig), LinearSkinning(mesh.rig)
    is_simulation = plan.pose_setter.target.follows == SIMULATION
    spread = sorted({int(number * GOLDEN_RATIO * plan.total) % plan.total for number in range(MAX_CHECKED_POSES)})
    pose_indices = range(min(plan.total, 2 if plan.pose_setter.settler else plan.total)) if is_simulation else spread
    first, rig_moved, target_moved = None, 0.0, 0.0
    with closing(plan.show_poses(player, pose_indices)) as poses:
        for done, _ in enumerate(poses, 1):
            pose, positions, _ = evaluator.evaluate()
            skinned = skinning.positions(pose[None])[0]
            if first is None:
                first = skinned, positions
            rig_moved = max(rig_moved, float(np.abs(skinned - first[0]).max()))
            target_moved = max(target_moved, float(np.abs(positions - first[1]).max()))
            yield Progress("target", min(done, len(pose_indices)), len(pose_indices))
            if (
                target_moved > MAX_STILL_TARGET_RATIO * mesh.rig.size
                and rig_moved > MIN_RIG_MOTION_RATIO * mesh.rig.size
            ):
                break
            if is_simulation and rig_moved > 10 * MIN_RIG_MOTION_RATIO * mesh.rig.size:
                break
    player.stop()
    if rig_moved > MIN_RIG_MOTION_RATIO * mesh.rig.size and target_moved <= MAX_STILL_TARGET_RATIO * mesh.rig.size:
        raise RigError(
            f"The target '{plan.pose_setter.target.name}' does not move while '{mesh.name}' does, by "
            f"{_format_mm(mesh, rig_moved)}; look whether its modifiers are on and its cache is that of this action, "
            "or choose another target."
        )


def _format_mm(mesh: WeightsFitted, units: float) -> str:
    return f"{units * mesh.rig.metres_per_unit * 1000:.0f} mm"
