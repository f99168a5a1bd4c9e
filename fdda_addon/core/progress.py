# SPDX-License-Identifier: GPL-3.0-or-later
"""The progress of a job, which its generator yields."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Progress:
    """Progress of one stage of a job.

    Attributes:
        stage: name of the stage.
        done, total: steps that are complete, and all steps of the stage.
        note: a sentence for the user; may be empty.
        detail: a few words about the last step; may be empty.
    """

    stage: str
    done: int
    total: int
    note: str = ""
    detail: str = ""
