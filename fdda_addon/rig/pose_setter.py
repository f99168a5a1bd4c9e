# SPDX-License-Identifier: GPL-3.0-or-later
"""Sets poses of a rig whose surface, or whose target, follows from the pose or the frame alone."""

from collections.abc import Callable, Container, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from ..core.mathematics.poses import Channel
from ..core.recording.target import RecordedTarget
from ..core.settings import LEARN_FROM, PRE_ROLL, REPEATABILITY_POSES, REST_THRESHOLD_MM, SETTLE_FRAMES
from ..poses.clip import Clip
from ..poses.clip_player import ClipPlayer
from .target import Target

PoseFunction = Callable[[float], None]
"""Sets a pose between the rest pose and another pose, given a fraction from 0 to 1."""


@dataclass(frozen=True)
class TargetSettings:
    """Settings of a target.

    Attributes:
        name: name of its object; empty for the rig itself.
        pre_roll: frames before the first frame of an action, in which the rig moves from the rest pose to that frame.
        settle_frames: largest number of frames for which a random pose is held until the target is at rest; 0 to
            hold no pose.
        rest_threshold_mm: the target is at rest when no vertex moves by more in a frame, mm.
        repeatability_poses: number of held poses, or frames of actions, that are set a second time, from another
            direction.
    """

    name: str = LEARN_FROM.default
    pre_roll: int = PRE_ROLL.field()
    settle_frames: int = SETTLE_FRAMES.field()
    rest_threshold_mm: float = REST_THRESHOLD_MM.field()
    repeatability_poses: int = REPEATABILITY_POSES.field()


NO_TARGET = TargetSettings()
"""The surface of the rig itself is evaluated."""


def blend_from_rest(
    set_values: Callable[[np.ndarray], None], channels: Sequence[Channel], values: np.ndarray
) -> PoseFunction:
    """Return a function that sets a fraction of a pose.

    Args:
        set_values: sets the values of the channels.
        channels: C channels.
        values: (C,) values of the pose.
    """

    def set_fraction(fraction: float) -> None:
        if fraction == 1:
            set_values(values)
        else:
            rest = np.array([channel.rest for channel in channels])
            set_values(rest + fraction * (values - rest))

    return set_fraction


class PoseSetter:
    """Sets poses of a rig; `SimulatedPoseSetter` sets those of a simulated target.

    Attributes:
        target: the target; None for the rig itself.
    """

    def __init__(self, target: Target | None = None, pre_roll: int = 0):
        """Prepare to set poses.

        Args:
            target: as in the class.
            pre_roll: as in `TargetSettings`.
        """
        self.target, self._pre_roll = target, pre_roll

    @property
    def recorded_target(self) -> RecordedTarget | None:
        """Return the description of the target in a recording; None without a target."""
        return RecordedTarget(self.target.name, self.target.follows, self._pre_roll) if self.target else None

    @property
    def depends_on_history(self) -> bool:
        """Return whether the surface may depend on earlier poses, not only on the current one."""
        return False

    @property
    def is_settling(self) -> bool:
        """Return whether random poses are held until the target is at rest."""
        return False

    @property
    def is_at_rest(self) -> bool:
        """Return whether the last random pose came to rest, or was not held."""
        return True

    @property
    def rest_description(self) -> str:
        """Return how the target came to rest in the last random pose; empty if poses are not held."""
        return ""

    @property
    def seconds_per_pose(self) -> float | None:
        """Return the seconds that the last random pose took to settle; None if they were not measured."""
        return None

    @contextmanager
    def prepared(self) -> Iterator[None]:
        """Prepare the target for random poses; restore it afterwards."""
        yield

    def set_pose(self, pose: PoseFunction, via_pose: PoseFunction | None = None) -> None:
        """Set a random pose; a simulation moves through `via_pose` on the way."""
        pose(1)

    def show_frames(self, player: ClipPlayer, clip: Clip, frame_indices: Container[int]) -> Iterator[int]:
        """Show frames of a clip in their order, one for each iteration, and yield their indices in the clip."""
        for index, frame in enumerate(clip.frames):
            if index in frame_indices:
                player.show(clip, frame)
                yield index


DIRECT_POSE_SETTER = PoseSetter()
"""Sets poses of a rig, whose surface follows from the pose at once."""
