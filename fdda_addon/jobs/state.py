# SPDX-License-Identifier: GPL-3.0-or-later
"""The state of a running or ended job, which panels draw."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

from ..core.progress import Progress

CHARACTER, ENVIRONMENT = "character", "environment"
"""Kinds of jobs. A job on a character ends when another file is opened. A job on the training environment uses no data
of Blender and continues."""
STAGE_UNITS = {
    "influences": "bones and inputs moved alone",
    "fit": "vertices fitted",
    "key joints": "bones compared with others",
    "probes": "poses compared with the rig",
    "target": "poses of the target checked",
    "epochs": "training passes",
    "repeatability": "poses repeated",
    "evaluation": "poses compared",
    "benchmark": "measurements",
    "film": "frames rendered",
    "full rig": "poses of the full rig",
    "repeated poses": "poses repeated",
    "fast rig": "poses of the fast rig",
}
"""Labels of the steps of a stage, where they differ from the name of the stage."""
PREPARING_STAGES = {
    *("starting", "partitions prepared", "poses to fit", "key joints", "fit", "target", "probes"),
    *("full rig", "repeated poses", "fast rig"),
}
"""Stages that are always followed by another stage of the same job."""
JobStep = tuple[str, tuple[str, ...]]
"""A step of a job: what is done, as a participle ("recording"), and the stages of `Progress` that belong to it."""


@dataclass
class JobState:
    """State of a running or ended job, for panels.

    Attributes:
        verb: name of the job in the operator's bl_idname ("record").
        title: label of the job ("Recording").
        subject: session_uid of its object, 0 for none.
        works_on: `CHARACTER` or `ENVIRONMENT`.
        can_cancel: whether it can be canceled.
        changes_scene: whether the job changes the scene and restores it.
        is_running: whether it is running.
        cancel_requested: whether the user has requested cancellation.
        steps: the steps of a job; empty for a job with one.
        step: index of the running step.
        stage, done, total: progress. If the number of steps is unknown, total is 0 and done counts seconds.
        ended: when it ended, a time of `time.monotonic`, seconds.
        note: why something that the user has tried must wait; empty for nothing.
        outcome: message at the end of the job; empty while it runs.
        outcome_level: 'INFO', 'WARNING' (canceled) or 'ERROR'.
        warnings: messages about the recording.
        curves: error after each epoch, mm, by name ("training", "validation"); empty for other jobs.
    """

    verb: str
    title: str
    subject: int = 0
    changes_scene: bool = False
    works_on: str = CHARACTER
    can_cancel: bool = True
    is_running: bool = True
    cancel_requested: bool = False
    steps: Sequence[JobStep] = ()
    step: int = 0
    stage: str = ""
    done: int = 0
    total: int = 0
    ended: float = 0.0
    note: str = ""
    outcome: str = ""
    outcome_level: str = "INFO"
    warnings: list[str] = field(default_factory=list)
    curves: dict[str, list[float]] = field(default_factory=dict)
    _stage_start: tuple[float, int] = (0.0, 0)

    @property
    def busy_text(self) -> str:
        """Return why an operator must wait."""
        return f"{self.title} is under way; wait for it or cancel it"

    @property
    def fraction(self) -> float:
        """Return the completed ratio of the stage, 0 to 1."""
        return self.done / self.total if self.total else 0.0

    @property
    def remaining_seconds(self) -> float | None:
        """Return the estimated remaining time of the stage; None if it is unknown."""
        start, first_done = self._stage_start
        if not self.total or self.done <= first_done:
            return None
        return (time.monotonic() - start) / (self.done - first_done) * (self.total - self.done)

    @property
    def heading(self) -> str:
        """Return a short text for the progress bar: "Step 2 of 5" or "Recording"."""
        return f"Step {self.step + 1} of {len(self.steps)}" if len(self.steps) > 1 else self.title

    @property
    def detail(self) -> str:
        """Return the progress of the stage: "Training: 50 of 200", "Poses compared: 3 of 10", "Starting…"."""
        stage, separator, mesh_part = self.stage.partition(" of '")
        step_label, step_stages = self.steps[self.step] if self.steps else ("", ())
        label = step_label if stage in ("", *step_stages[:1]) else STAGE_UNITS.get(stage, stage)
        if not self.stage:
            return f"{label[:1].upper()}{label[1:]}…" if label else "Starting…"
        count = f"{self.done:,} of {self.total:,}" if self.total else f"{self.done} s"
        return f"{label[:1].upper()}{label[1:]}{separator}{mesh_part}: {count}"

    @property
    def sentence(self) -> str:
        """Return heading and detail in one line: "Step 2 of 5: training: 50 of 200"."""
        heading = "" if self.heading == self.title else f"{self.heading}: "
        return heading + (self.detail[:1].lower() + self.detail[1:] if heading else self.detail)

    @property
    def remaining_text(self) -> str:
        """Return the remaining time as text: "About 5 min left", with steps that follow "in this step"; "…" before."""
        if self.is_finishing:
            return "Finishing…"
        seconds_left = self.remaining_seconds
        if seconds_left is None:
            return "…"
        return f"About {format_duration(seconds_left)} left{'' if self.is_in_last_step else ' in this step'}"

    @property
    def is_in_last_step(self) -> bool:
        """Return whether no step follows."""
        return self.step >= len(self.steps) - 1

    @property
    def is_finishing(self) -> bool:
        """Return whether the last stage is complete."""
        is_complete = self.is_in_last_step and 0 < self.total == self.done
        return is_complete and self.stage.partition(" of '")[0] not in PREPARING_STAGES

    def show(self, progress: Progress) -> None:
        """Update the progress."""
        if progress.stage != self.stage or progress.done < self.done:
            self.stage, self._stage_start = progress.stage, (time.monotonic(), progress.done)
            name = progress.stage.partition(" of '")[0]
            later_steps = range(self.step, len(self.steps))
            self.step = next((index for index in later_steps if name in self.steps[index][1]), self.step)
        self.done, self.total = progress.done, progress.total


def format_duration(seconds: float) -> str:
    """Return a duration as text: "40 s", "5 min", "2 h 10 min"."""
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"
