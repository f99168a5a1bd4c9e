# SPDX-License-Identifier: GPL-3.0-or-later
"""The poses of an evaluation."""

from collections.abc import Iterable
from dataclasses import dataclass

from ..core.settings import EVALUATION_POSES, EVALUATION_SEED
from ..poses.clip import Clip
from ..rig.pose_setter import NO_TARGET, TargetSettings


@dataclass(frozen=True)
class EvaluationSettings:
    """The poses of an evaluation.

    Attributes:
        poses: number of random held-out poses; if 0, the frames of the first action or strip replace them.
        seed: seed of the random poses.
        actions, strips: names of actions and of NLA strips whose frames are compared too.
        range_scales: factors that widen the range of motion for further random poses. Each factor has a quarter as many
            poses as `poses`.
        surface: whether to compare normals and edges too, which takes longer than the rest of the evaluation.
        target: settings of the target to compare with; by default the rig itself.
    """

    poses: int = EVALUATION_POSES
    seed: int = EVALUATION_SEED
    actions: tuple[str, ...] = ()
    range_scales: tuple[float, ...] = ()
    surface: bool = True
    strips: tuple[str, ...] = ()
    target: TargetSettings = NO_TARGET

    @property
    def scaled_poses(self) -> int:
        """Number of random poses of each factor of `range_scales`."""
        return max(1, self.poses // 4)

    def total_poses(self, clips: Iterable[Clip]) -> int:
        """Return the number of poses, with the frames of the clips."""
        of_clips = sum(len(clip.frames) for clip in clips)
        return self.poses + self.scaled_poses * len(self.range_scales) + of_clips
