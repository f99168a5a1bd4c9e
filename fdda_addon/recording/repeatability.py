# SPDX-License-Identifier: GPL-3.0-or-later
"""Measures the repeatability of a target: its distance from itself when a pose is reached from another direction."""

from collections.abc import Iterator
from contextlib import closing

import numpy as np

from ..core.mathematics.metrics import distances, error_statistics
from ..core.mathematics.partition import GOLDEN_RATIO
from ..core.progress import Progress
from ..core.recording.arrays import open_array
from ..core.recording.target import Repeatability
from ..core.recording.writer import RecordingWriter
from ..poses.clip_player import ClipPlayer
from ..rig.reading import PoseEvaluator
from .pose_plan import PosePlan


def measure_repeatability(
    evaluator: PoseEvaluator, plan: PosePlan, player: ClipPlayer | None, writer: RecordingWriter, max_poses: int
) -> Iterator[Progress]:
    """Reach some poses from another direction, and write the distance from the recorded target to the index.

    Does nothing if the repeatability was measured before. Poses that did not come to rest are left out.

    Args:
        evaluator: evaluates the target.
        plan: plan of the poses.
        player: player of the clips; None without clips.
        writer: writer of the complete recording.
        max_poses: largest number of poses.

    Yields:
        Progress of the stage "repeatability".
    """
    repeatable_indices = [index for index in plan.repeatable_poses if index not in writer.unsettled]
    if writer.repeatability or not repeatable_indices:
        return
    pose_indices = sorted(
        {
            repeatable_indices[int(number * GOLDEN_RATIO * len(repeatable_indices)) % len(repeatable_indices)]
            for number in range(max_poses)
        }
    )
    shape = writer.complete, writer.rig.vertex_count, 3
    recorded, pose_distances = open_array(writer.path / "positions.npy", shape, np.float32), []
    # Closing the generator stops playback.
    with closing(plan.show_poses_again(player, pose_indices)) as shown_poses:
        for compared_count, pose_index in enumerate(shown_poses, 1):
            positions = evaluator.evaluate()[1]
            pose_distances.append(distances(positions, recorded[pose_index], writer.rig.metres_per_unit))
            detail = plan.pose_setter.rest_description
            yield Progress("repeatability", compared_count, len(pose_indices), detail=detail)
    statistics = error_statistics(np.stack(pose_distances)).to_json()
    writer.set_repeatability(
        Repeatability(tuple(pose_indices), {name: round(value, 6) for name, value in statistics.items()})
    )
