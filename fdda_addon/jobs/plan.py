# SPDX-License-Identifier: GPL-3.0-or-later
"""The steps of a long job, for "Step 2 of 5" and for the remaining time of the whole job."""

from collections.abc import Sequence
from dataclasses import dataclass

LOADING_SECONDS = 6.0
"""Time until a trainer has loaded PyTorch and read a recording."""
SECONDS_PER_PARTITION, SECONDS_PER_VERTEX = 1.0, 4e-4
"""Times to train a body part, and per vertex, with 1,000 poses and 200 epochs: the 19, 22 and 38 s of the sample arm
with 22 parts in docs/benchmarks.md. The measured time of an epoch replaces the estimate as soon as there is one."""


@dataclass(frozen=True)
class JobStep:
    """A step of a job.

    Attributes:
        label: what is done, as a participle: "recording".
        stages: names of the stages of `Progress` that belong to the step.
        seconds: estimated time of the step; None if it follows from the time of a pose.
        poses: number of poses that the step evaluates; 0 if it evaluates none.
    """

    label: str
    stages: tuple[str, ...]
    seconds: float | None = None
    poses: int = 0


class JobPlan:
    """The steps of a job, and which of them is running."""

    def __init__(self, steps: Sequence[JobStep]):
        self.steps, self.index = tuple(steps), 0

    @property
    def current(self) -> JobStep:
        """Return the running step."""
        return self.steps[self.index]

    @property
    def is_last(self) -> bool:
        """Return whether the last step is running."""
        return self.index == len(self.steps) - 1

    @property
    def heading(self) -> str:
        """Return the text "Step 2 of 5"; empty if there is only one step."""
        return f"Step {self.index + 1} of {len(self.steps)}" if len(self.steps) > 1 else ""

    def enter(self, stage: str) -> None:
        """Go on to the next step that has a stage; stay if there is none."""
        for index in range(self.index, len(self.steps)):
            if stage in self.steps[index].stages:
                self.index = index
                return

    def begin_training(self, number: int) -> None:
        """Go on to the first step of a training.

        Args:
            number: 0 for the first training of the job, 1 for the next.
        """
        starts = [index for index, step in enumerate(self.steps) if "starting" in step.stages]
        self.index = starts[number]

    def later_seconds(self, seconds_per_pose: float | None) -> float | None:
        """Return the estimated time of all steps after the running one; None if it is unknown."""
        total = 0.0
        for step in self.steps[self.index + 1 :]:
            seconds = step.seconds
            if step.poses:
                seconds = None if seconds_per_pose is None else step.poses * seconds_per_pose
            if seconds is None:
                return None
            total += seconds
        return total


def recording_steps(pose_count: int, has_target: bool = False) -> list[JobStep]:
    """Return the steps of a recording."""
    check = [JobStep("checking the object", ("target",), None, 1)] if has_target else []
    return [*check, JobStep("recording", ("poses", "influences", "repeatability"), None, pose_count)]


def training_steps(
    partition_count: int, vertex_count: int, pose_count: int, epochs: int, fits_weights: bool = False
) -> list[JobStep]:
    """Return the steps of a training, with their estimated times."""
    seconds = SECONDS_PER_PARTITION * partition_count + SECONDS_PER_VERTEX * vertex_count
    seconds *= pose_count / 1000
    return [
        JobStep("reading the recording", ("starting",), LOADING_SECONDS),
        *([JobStep("fitting the skinning", ("key joints", "fit"), 10.0)] if fits_weights else ()),
        JobStep("preparing body parts", ("partitions prepared",), 0.2 * seconds),
        JobStep("training", ("epochs",), 0.8 * seconds * epochs / 200),
    ]
