# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs: generators that work while they are iterated, yield their progress and return their result."""

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import TypeVar


@dataclass(frozen=True)
class Progress:
    """Progress of one stage of a job.

    Attributes:
        stage: name of the stage.
        done, total: number of complete steps, and of all steps of the stage.
        note: a sentence for the user; may be empty.
        detail: a few words about the last step; may be empty.
    """

    stage: str
    done: int
    total: int
    note: str = ""
    detail: str = ""


Result = TypeVar("Result")
Job = Generator[Progress | None, None, Result]
"""A job; it yields None while it waits for another process."""


def run_job(job: Job[Result], show: Callable[[Progress], object] | None = None) -> Result:
    """Iterate a job to its end, show its progress, and return its result."""
    while True:
        try:
            step = next(job)
        except StopIteration as end:
            return end.value
        if show and step:
            show(step)
