# SPDX-License-Identifier: GPL-3.0-or-later
"""How far apart what a target shows in one pose is, by the way there: below that no model of the pose can go."""

from collections.abc import Iterator
from contextlib import closing

import numpy as np

from ..core.metrics import distances, error_statistics
from ..core.partition import GOLDEN_RATIO
from ..core.progress import Progress
from ..core.recording.arrays import open_array
from ..core.recording.target import Repeatability
from ..core.recording.writer import RecordingWriter
from ..core.skinning import LinearSkinning
from ..poses.clip_player import ClipPlayer
from .phases import InfluencesReady
from .pose_plan import PosePlan


def measure_repeatability(
    mesh: InfluencesReady, plan: PosePlan, player: ClipPlayer | None, writer: RecordingWriter, count: int
) -> Iterator[Progress]:
    """Reach some poses of a recording over another way, and note how far the target is from what was recorded.

    Nothing is done where that was noted before. Poses that did not come to rest are not repeated.

    Args:
        mesh: whose poses were recorded.
        plan: of the poses.
        player: plays its clips; None where there are none.
        writer: of the recording, all poses of which are complete.
        count: how many poses are repeated at most.

    Yields:
        Progress of the stage "repeatability".
    """
    found = [number for number in plan.repeatable if number not in writer.unsettled]
    if writer.repeatability or not found:
        return
    numbers = sorted({found[int(number * GOLDEN_RATIO * len(found)) % len(found)] for number in range(count)})
    rig, skinning, settler = writer.rig, LinearSkinning(writer.rig, writer.partitions), plan.pose_setter.settler
    recorded = open_array(writer.path / "residuals.npy", (writer.complete, rig.vertex_count, 3), np.float32)
    apart, linear = [], []
    # So that what plays is stopped.
    with closing(plan.poses_again(player, numbers)) as again:
        for done, number in enumerate(again, 1):
            pose, positions, _ = mesh.evaluator.evaluate()
            before = skinning.complex_positions(pose[None], np.array(recorded[number])[None])[0]
            apart.append(distances(positions, before, rig.metres_per_unit))
            linear.append(distances(before, skinning.positions(pose[None])[0], rig.metres_per_unit))
            yield Progress("repeatability", done, len(numbers), detail=str(settler.last) if settler else "")
    statistics = {name: round(value, 6) for name, value in error_statistics(np.stack(apart)).to_json().items()}
    writer.set_repeatability(Repeatability(tuple(numbers), statistics, round(float(np.mean(linear)) * 1000, 6)))
