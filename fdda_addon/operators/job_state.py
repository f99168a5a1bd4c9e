# SPDX-License-Identifier: GPL-3.0-or-later
"""The job under way and those that have ended: what panels draw, and what ends a job from outside.

A job is a generator that works while it is iterated: it yields `Progress`, None when there is nothing to do at the
moment, and at most one other value, its result. One job at a time.
"""

import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field

import bpy
from bpy.app.handlers import persistent

from ..core.errors import FDDAError
from ..core.progress import Progress

LOG_LINES = 2000


@dataclass
class JobState:
    """A job as panels draw it, under way or ended.

    Attributes:
        verb: which job, the name in the operator's bl_idname ("record").
        title: what it does, for people ("Recording").
        subject: name of the object that it is about, empty for none.
        borrows_scene: it changes the scene and gives it back when it ends.
        is_running: under way.
        cancel_requested: the user wants it to end.
        stage, done, total: how far it is; total is 0 as long as nothing is known.
        started, ended: `time.monotonic` seconds.
        outcome: how it ended, a sentence; empty while it runs.
        outcome_level: 'INFO', 'WARNING' (cancelled) or 'ERROR'.
        log: lines of text that the job wrote, the last `LOG_LINES`.
        curves: values by name, one for each step, for jobs that have some ("training", "validation").
    """

    verb: str
    title: str
    subject: str = ""
    borrows_scene: bool = False
    is_running: bool = True
    cancel_requested: bool = False
    stage: str = ""
    done: int = 0
    total: int = 0
    started: float = field(default_factory=time.monotonic)
    ended: float = 0.0
    outcome: str = ""
    outcome_level: str = "INFO"
    log: deque[str] = field(default_factory=lambda: deque(maxlen=LOG_LINES))
    curves: dict[str, list[float]] = field(default_factory=dict)
    _stage_start: tuple[float, int] = (0.0, 0)

    @property
    def fraction(self) -> float:
        """Part of the stage that is done, 0 to 1."""
        return self.done / self.total if self.total else 0.0

    @property
    def remaining_seconds(self) -> float | None:
        """How long the stage will still take at its speed so far, None when that cannot be said."""
        began, first = self._stage_start
        if self.done <= first or not self.is_running:
            return None
        return (time.monotonic() - began) / (self.done - first) * (self.total - self.done)

    def show(self, progress: Progress) -> None:
        """Note how far the job is."""
        if progress.stage != self.stage:
            self.stage, self._stage_start = progress.stage, (time.monotonic(), progress.done)
        self.done, self.total = progress.done, progress.total
        if progress.note:
            self.log.append(progress.note)


_states: dict[str, JobState] = {}
_running: "Run | None" = None


def current() -> JobState | None:
    """The job that runs, None when there is none."""
    return _running.state if _running else None


def state_of(verb: str) -> JobState | None:
    """The job of this verb that runs or was the last to run in this session, None when there was none."""
    return _states.get(verb)


def request_cancel() -> None:
    """Ask the job to end; what it has kept stays."""
    if _running:
        _running.state.cancel_requested = True


def stop(reason: str) -> None:
    """End the job now, if one runs: its generator is closed, so what it borrowed is given back and its process ends.

    Args:
        reason: the sentence that panels show.
    """
    if _running:
        run = _running
        try:
            run.close()
        except FDDAError as error:
            reason = f"{reason} {error}"
        run.end(reason, "WARNING")


class Run:
    """The job under way: its state and its generator."""

    def __init__(self, state: JobState, steps: Iterator):
        global _running
        self.state, self.steps = state, steps
        self.result: object = None
        self.is_waiting = False
        _states[state.verb] = state
        _running = self

    def advance(self, seconds: float) -> bool:
        """Work for about so long, or until the job waits; returns whether it is done."""
        until = time.monotonic() + seconds
        self.is_waiting = False
        while True:
            try:
                step = next(self.steps)
            except StopIteration:
                return True
            if step is None:
                self.is_waiting = True
                return False
            if isinstance(step, Progress):
                self.state.show(step)
            else:
                self.result = step
            if self.state.cancel_requested or time.monotonic() >= until:
                return False

    def close(self) -> None:
        """End the generator where it is.

        Raises:
            FDDAError: what it still had to do failed.
        """
        self.steps.close()

    def end(self, outcome: str, level: str) -> None:
        """Note how the job ended; another may begin."""
        global _running
        state = self.state
        state.is_running, state.ended, state.outcome, state.outcome_level = False, time.monotonic(), outcome, level
        if _running is self:
            _running = None
        redraw()


def redraw() -> None:
    """Draw the sidebars and the preferences again."""
    for window in getattr(bpy.context.window_manager, "windows", ()):
        for area in window.screen.areas:
            if area.type in {"VIEW_3D", "PREFERENCES"}:
                for region in area.regions:
                    if region.type == "UI" or area.type == "PREFERENCES":
                        region.tag_redraw()


def _stop(reason: str) -> None:
    if _running:
        stop(f"{_running.state.title} ended because {reason}.")


@persistent
def _on_load(*_: object) -> None:
    _stop("another file was opened")


@persistent
def _on_undo(*_: object) -> None:
    if _running and _running.state.borrows_scene:
        _stop("the scene was undone")


HANDLERS = {"load_pre": _on_load, "undo_pre": _on_undo, "redo_pre": _on_undo}


def register() -> None:
    """Let another file and an undo end the job."""
    for name, handler in HANDLERS.items():
        if handler not in getattr(bpy.app.handlers, name):
            getattr(bpy.app.handlers, name).append(handler)


def unregister() -> None:
    """End the job and undo `register`. Blender does this when it is closed."""
    _stop("the add-on was disabled")
    for name, handler in HANDLERS.items():
        if handler in getattr(bpy.app.handlers, name):
            getattr(bpy.app.handlers, name).remove(handler)
