# SPDX-License-Identifier: GPL-3.0-or-later
"""How far a job is: what every generator that works yields."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Progress:
    """`done` of `total` steps of the stage are done; `note` is a sentence for the user, where there is one to say, and
    `detail` what there is to say of the last step in a few words."""

    stage: str
    done: int
    total: int
    note: str = ""
    detail: str = ""
