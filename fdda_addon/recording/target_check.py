# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether a target follows its rig at all, looked at before anything is recorded."""

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

MOST_POSES = 20
RIG_MOVES, TARGET_STANDS = 0.02, 1e-5
"""Parts of the character's size: a target that moved by less than the second, while the rig moved by more than the
first, does not follow it."""


def check_moves(mesh: WeightsFitted, plan: PosePlan, player: ClipPlayer) -> Iterator[Progress]:
    """Fail where a target stands still in poses of a plan in which the rig moves.

    A simulation is looked at in its first frames, all else in poses that lie far apart. Poses that are held come to
    rest, so that what one takes is known afterwards.

    Yields:
        Progress of the stage "target".

    Raises:
        RigError: it does not move.
    """
    evaluator, skinning = mesh.planned.evaluator(mesh.rig), LinearSkinning(mesh.rig)
    in_order = plan.pose_setter.target.follows == SIMULATION
    spread = sorted({int(number * GOLDEN_RATIO * plan.total) % plan.total for number in range(MOST_POSES)})
    wanted = range(min(plan.total, 2 if plan.pose_setter.settler else plan.total)) if in_order else spread
    first, rig_moved, target_moved = None, 0.0, 0.0
    with closing(plan.poses(player, wanted)) as poses:
        for done, _ in enumerate(poses, 1):
            pose, positions, _ = evaluator.evaluate()
            skinned = skinning.positions(pose[None])[0]
            if first is None:
                first = skinned, positions
            rig_moved = max(rig_moved, float(np.abs(skinned - first[0]).max()))
            target_moved = max(target_moved, float(np.abs(positions - first[1]).max()))
            yield Progress("target", min(done, len(wanted)), len(wanted))
            if target_moved > TARGET_STANDS * mesh.rig.size and rig_moved > RIG_MOVES * mesh.rig.size:
                break
            if in_order and rig_moved > 10 * RIG_MOVES * mesh.rig.size:
                break
    player.stop()
    if rig_moved > RIG_MOVES * mesh.rig.size and target_moved <= TARGET_STANDS * mesh.rig.size:
        raise RigError(
            f"The target '{plan.pose_setter.target.name}' does not move while '{mesh.name}' does, by "
            f"{_mm(mesh, rig_moved)}; look whether its modifiers are on and its cache is that of this action, or "
            "choose another target."
        )


def _mm(mesh: WeightsFitted, units: float) -> str:
    return f"{units * mesh.rig.metres_per_unit * 1000:.0f} mm"
