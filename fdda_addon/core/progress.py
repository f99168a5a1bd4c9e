# SPDX-License-Identifier: GPL-3.0-or-later
"""Progress of a job; the generator that runs the job yields it."""

from dataclasses import dataclass


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
