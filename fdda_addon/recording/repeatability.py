# SPDX-License-Identifier: GPL-3.0-or-later
"""Repeatability of a target: how far it is from itself when a pose is reached from another direction."""

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
    """Reach some poses from another direction, and write the distance from the recorded target to the index.

    Does nothing where it was measured before. Poses that did not come to rest are left out.

    Args:
        mesh: the recorded mesh.
        plan: of the poses.
        player: of the clips; None where there are none.
        writer: of the complete recording.
        count: largest number of poses.

    Yields:
        Progress of the stage "repeatability".
    """
    candidates = [number for number in plan.repeatable_poses if number not in writer.unsettled]
    if writer.repeatability or not candidates:
        return
    numbers = sorted(
        {candidates[int(number * GOLDEN_RATIO * len(candidates)) % len(candidates)] for number in range(count)}
    )
    rig, skinning, settler = writer.rig, LinearSkinning(writer.rig, writer.partitions), plan.pose_setter.settler
    recorded = open_array(writer.path / "residuals.npy", (writer.complete, rig.vertex_count, 3), np.float32)
    target_distances, linear_distances = [], []
    # Closing the generator stops playback.
    with closing(plan.show_poses_again(player, numbers)) as shown_poses:
        for done, number in enumerate(shown_poses, 1):
            pose, positions, _ = mesh.evaluator.evaluate()
            before = skinning.complex_positions(pose[None], np.array(recorded[number])[None])[0]
            target_distances.append(distances(positions, before, rig.metres_per_unit))
            linear_distances.append(distances(before, skinning.positions(pose[None])[0], rig.metres_per_unit))
            yield Progress("repeatability", done, len(numbers), detail=str(settler.last_rest_state) if settler else "")
    statistics = {
        name: round(value, 6) for name, value in error_statistics(np.stack(target_distances)).to_json().items()
    }
    writer.set_repeatability(
        Repeatability(tuple(numbers), statistics, round(float(np.mean(linear_distances)) * 1000, 6))
    )
