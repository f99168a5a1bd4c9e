# SPDX-License-Identifier: GPL-3.0-or-later
"""What this session knows of the trainer's Python, and what it is finding out: for panels to draw.

Nothing here is asked while drawing; `answer` is what the last check said. Long work runs in a thread of its own, which
waits for other processes and touches no Blender data.
"""

import threading
from collections.abc import Callable, Generator

from ..core.errors import FDDAError
from ..core.progress import Progress
from .answer import Answer
from .folder import FolderState, folder_state, own_folder


class Task:
    """A generator that runs in a thread.

    Attributes:
        title: what it does.
        progress: the last that it yielded.
        outcome: how it ended, None while it runs.
        keep: takes the outcome.
    """

    def __init__(
        self,
        title: str,
        steps: Generator[Progress | Answer],
        cancel: Callable[[], None] | None,
        keep: Callable[[Answer], None],
    ):
        """Start it.

        Args:
            title: what it does.
            steps: yields how far it is, and last its outcome.
            cancel: called from another thread, has `steps` end soon; None where that is not possible.
            keep: takes the outcome, in the main thread.
        """
        self.title, self.progress, self.outcome = title, Progress("starting", 0, 0), None
        self.keep, self._steps, self._cancel = keep, steps, cancel
        self._cancelled = False
        self._thread = threading.Thread(target=self._work, name=f"FDDA: {title}", daemon=True)
        self._thread.start()

    @property
    def can_cancel(self) -> bool:
        return self._cancel is not None

    def cancel(self) -> None:
        """Have it end soon."""
        if self._cancel is not None:
            self._cancelled = True
            self._cancel()

    def wait(self, seconds: float) -> None:
        """Wait until it has ended, for a while at most."""
        self._thread.join(seconds)

    def _work(self) -> None:
        outcome = Answer("ERROR", f"{self.title} broke off; the system console says why.")
        try:
            for step in self._steps:
                if isinstance(step, Answer):
                    outcome = step
                else:
                    self.progress = step
        except FDDAError as error:
            outcome = Answer("WARNING" if self._cancelled else "ERROR", str(error))
        finally:
            self.outcome = outcome


task: Task | None = None
"""What is under way."""
answer: Answer | None = None
"""What the last check of the trainer's Python said; None: not checked in this session."""
notice: Answer | None = None
"""How the last creation or removal ended, when it did not end in an answer."""
_folder_state: FolderState | None = None

STOP_SECONDS = 10.0


def start(new_task: Task) -> None:
    """Have it be the task that is under way."""
    global task, notice
    task, notice = new_task, None


def end_task() -> Answer | None:
    """Keep the outcome of the task once it has ended, and return it; None before."""
    global task
    if task is None or task.outcome is None:
        return None
    ended, task = task, None
    ended.keep(ended.outcome)
    return ended.outcome


def remember(new_answer: Answer | None, new_notice: Answer | None = None) -> None:
    """Keep what was found out, and look at the environment's folder anew when it is next drawn."""
    global answer, notice, _folder_state
    answer, notice, _folder_state = new_answer, new_notice, None


def own_state() -> FolderState:
    """The state of the add-on's own environment as this session knows it."""
    global _folder_state
    if _folder_state is None:
        _folder_state = folder_state(own_folder())
    return _folder_state


def stop() -> None:
    """End what is under way and forget everything."""
    global task
    if task is not None:
        task.cancel()
        task.wait(STOP_SECONDS)
        task = None
    remember(None)
