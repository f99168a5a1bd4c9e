# SPDX-License-Identifier: GPL-3.0-or-later
"""A task of a farm: a verb with its input and output files."""

from dataclasses import dataclass
from pathlib import Path

from fdda_addon.core.report import REPORT_HTML, REPORT_JSON

REPORT = (REPORT_JSON, REPORT_HTML)
PICTURE_POSES = 20
"""Number of held-out poses whose errors the heat map shows."""


@dataclass(frozen=True)
class Round:
    """Condition of a round: it is skipped where the previous round was skipped or met the goal.

    Attributes:
        evaluate: name of the task that measured the model of the previous round.
        train: name of the task that trained this model. Its report tells whether more poses help.
        goal_mm: accuracy goal for 99.9 % of the vertices, mm.
    """

    evaluate: str
    train: str
    goal_mm: float


@dataclass(frozen=True)
class Task:
    """A node of the graph: verbs that run in their own processes and write into the folder of the task.

    Attributes:
        name: name such as "hero/record-2", which is also the path of its folder below `work`.
        kind: one of `KINDS`.
        character: name of the character.
        folder: absolute path of its folder.
        verbs: name and arguments of each verb, in the order in which they run.
        outputs: names of files and folders in its folder that exist when the task is done.
        after: names of the tasks that it depends on.
        files: absolute paths of external files that it reads.
        copies: (source, name): files of earlier tasks that are copied into the folder before the verbs run.
        publishes: (name, absolute path): outputs that are copied to their destination after the verbs.
        round: condition of a task in a round after the first.
        choices: only for `bind`: for each bound model, its name in the folder and the tasks (train, evaluate) of each
            round. The model with the smallest error is bound.
        poses: number of poses that it evaluates or learns from, which determines its duration.
    """

    name: str
    kind: str
    character: str
    folder: Path
    verbs: tuple[tuple[str, ...], ...]
    outputs: tuple[str, ...]
    after: tuple[str, ...] = ()
    files: tuple[Path, ...] = ()
    copies: tuple[tuple[Path, str], ...] = ()
    publishes: tuple[tuple[str, Path], ...] = ()
    round: Round | None = None
    choices: tuple[tuple[str, tuple[tuple[str, str], ...]], ...] = ()
    poses: int = 0

    @property
    def manifest(self) -> Path:
        """Path of the manifest, which is written when the task is done."""
        return self.folder.with_name(f"{self.folder.name}.json")

    @property
    def log(self) -> Path:
        """Path of the log, the output of its verbs."""
        return self.folder.with_name(f"{self.folder.name}.log")

    @property
    def lock(self) -> Path:
        """Path of the lock, which is held while a process of the task runs."""
        return self.folder.with_name(f"{self.folder.name}.lock")
