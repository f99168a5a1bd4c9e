# SPDX-License-Identifier: GPL-3.0-or-later
"""State of running and ended jobs, which panels draw, and functions that run and stop jobs.

One job at a time works on a character (`operators.job` iterates it), and one on the training environment (`background`
iterates it).
"""

import time
from collections.abc import Callable

import bpy
from bpy.app.handlers import persistent

from ..core.errors import FDDAError
from ..core.progress import Job
from ..scene import draw_cache
from .state import CHARACTER, ENVIRONMENT, JobState

_runners: "dict[str, JobRunner]" = {}
"""The last job of each verb; at most one of a kind runs. Another file ends and drops those of the previous file."""


def current_runner(works_on: str = CHARACTER) -> "JobRunner | None":
    """Return the running job of a kind; None if no job runs."""
    runners = (runner for runner in _runners.values() if runner.state.works_on == works_on)
    return next((runner for runner in runners if runner.state.is_running), None)


def current(works_on: str = CHARACTER) -> JobState | None:
    """Return the state of the running job of a kind; None if no job runs."""
    runner = current_runner(works_on)
    return runner.state if runner else None


def state_of(verb: str) -> JobState | None:
    """Return the state of the last job with a verb in this session; None without one."""
    runner = _runners.get(verb)
    return runner.state if runner else None


def request_cancel(works_on: str = CHARACTER) -> None:
    """Request the cancellation of the running job of a kind."""
    if state := current(works_on):
        state.cancel_requested = True


def stop(reason: str, works_on: str = CHARACTER) -> None:
    """Stop the running job now: its generator is closed, which restores the scene and ends its process.

    Args:
        reason: the message that panels show.
        works_on: kind of the job.
    """
    if runner := current_runner(works_on):
        try:
            runner.steps.close()
        except FDDAError as error:
            reason = f"{reason} {error}"
        runner.end(reason, "WARNING")


class JobRunner:
    """Runner of a job: its state, its generator, and its outcome."""

    def __init__(
        self,
        state: JobState,
        steps: Job[object],
        finish: Callable[[object], str],
        cancel_message: Callable[[], str],
        ends_itself: bool = False,
    ):
        """Register the job.

        Args:
            finish: processes the result and returns the outcome. The text of an FDDAError is the outcome too.
            cancel_message: returns the outcome of a canceled job that has no result.
            ends_itself: whether `steps` checks `state.cancel_requested` and ends soon; if not, it is closed.
        """
        self.state, self.steps = state, steps
        self.result: object = None
        self.is_waiting = False
        self._finish, self._cancel_message, self._ends_itself = finish, cancel_message, ends_itself
        _runners[state.verb] = self
        draw_cache.forget_actions()

    def work(self, seconds: float) -> bool:
        """Run the job for some seconds, or until it waits; return whether it has ended. Closing it restores the scene.

        KeyboardInterrupt and unexpected exceptions propagate, after the scene was restored and the job has ended.
        """
        title = self.state.title
        try:
            is_canceled = self.state.cancel_requested
            if is_canceled and not self._ends_itself:
                self.steps.close()
            elif not self.advance(seconds):
                return False
            if is_canceled and self.result is None:
                self.end(self._cancel_message(), "WARNING")
            else:
                self.end(self._finish(self.result), "INFO")
        except FDDAError as error:
            self.end(str(error), "WARNING" if is_canceled and self._ends_itself else "ERROR")
        except ReferenceError:
            self.end(f"{title} ended: its object was removed.", "ERROR")
        except BaseException:
            self.steps.close()
            self.end(f"{title} failed; see the system console.", "ERROR")
            raise
        return True

    def advance(self, seconds: float) -> bool:
        """Iterate the generator for some seconds, or until the job waits; return whether the generator has ended."""
        deadline = time.monotonic() + seconds
        self.is_waiting = False
        while True:
            try:
                step = next(self.steps)
            except StopIteration as end:
                self.result = end.value
                return True
            if step is None:
                self.is_waiting = True
                return False
            self.state.show(step)
            if self.state.cancel_requested or time.monotonic() >= deadline:
                return False

    def end(self, outcome: str, level: str) -> None:
        """Store the outcome and end the job, so that another job may start."""
        state = self.state
        state.is_running, state.ended, state.outcome, state.outcome_level = False, time.monotonic(), outcome, level
        # The result may be large, and only the state is asked for later.
        self.result = None
        redraw()


def redraw() -> None:
    """Redraw sidebars and preferences, with new values instead of cached ones."""
    draw_cache.clear()
    for window in getattr(bpy.context.window_manager, "windows", ()):
        for area in window.screen.areas:
            if area.type in {"VIEW_3D", "PREFERENCES"}:
                for region in area.regions:
                    if region.type == "UI" or area.type == "PREFERENCES":
                        region.tag_redraw()


def _stop(reason: str, works_on: str = CHARACTER) -> None:
    if state := current(works_on):
        stop(f"{state.title} ended because {reason}.", works_on)


@persistent
def _on_load(*_: object) -> None:
    _stop("another file was opened")
    # States refer to objects of the previous file.
    for verb in [verb for verb, runner in _runners.items() if not runner.state.is_running]:
        del _runners[verb]


@persistent
def _on_undo(*_: object) -> None:
    if (state := current()) and state.changes_scene:
        _stop("the scene was undone")


@persistent
def _on_save(*_: object) -> None:
    # The error may be that the file was not saved.
    states = [runner.state for runner in _runners.values()]
    for verb in [state.verb for state in states if not state.is_running and state.outcome_level == "ERROR"]:
        del _runners[verb]
    redraw()


HANDLERS = {"load_pre": _on_load, "save_post": _on_save, "undo_pre": _on_undo, "redo_pre": _on_undo}


def unregister() -> None:
    """Stop all jobs, also when Blender quits."""
    for works_on in (CHARACTER, ENVIRONMENT):
        _stop("the add-on was disabled", works_on)
