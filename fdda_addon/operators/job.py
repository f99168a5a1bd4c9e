# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators whose work takes more than a moment.

In a window a job advances a little at each tick of a timer; in the background, or when the operator is executed rather
than invoked, it runs to its end.
"""

import time
from collections.abc import Iterator

import bpy

from ..core.errors import FDDAError
from ..jobs.job import JobState, Run, current, redraw, request_cancel, stop, unregister

TICK_BUDGET, MAX_BUDGET = 0.03, 0.2
"""Seconds that a job may work at a tick; a step that is begun is finished, so steps must be short.

A job that borrows the scene has each of its poses drawn. Where drawing takes longer than the budget, it may work as
long as that took, or nearly all the time would go into pictures.
"""
TICK_SECONDS, IDLE_TICK_SECONDS = 0.01, 0.1
"""Between the ticks of a job that works in Blender, and of one that waits for another process."""
BACKGROUND_STEP_SECONDS = 0.05
REDRAW_SECONDS = 0.1
TAB_STRIP_WIDTH = 24

VIEW_EVENTS = {"MOUSEMOVE", "INBETWEEN_MOUSEMOVE", "MIDDLEMOUSE", "WHEELUPMOUSE", "WHEELDOWNMOUSE", "WINDOW_DEACTIVATE"}
"""Events that are passed on while a job borrows the scene: looking is allowed, changing is not."""


class JobOperator:
    """Mixin for an operator that runs a job.

    A subclass states `verb` and `title`, and defines `steps`, `finish` and `cancelled`. FDDAErrors of all three are
    reported, and the operator is cancelled. Invoked in a window the job runs in ticks, otherwise to its end at once.
    """

    verb = ""
    title = ""
    borrows_scene = True
    """The job changes the scene and gives it back: meanwhile the user may look, but not touch, and ESC cancels."""
    changes_file = False
    """The job has changed what the .blend file keeps. Its end is then a step of Blender's undo, and marks the file as
    changed, so that Blender asks before it closes the file."""
    ends_itself = False
    """`steps` watches `state.cancel_requested` and ends soon: for a process that takes its time to stop."""

    def steps(self, context: bpy.types.Context) -> Iterator[object]:
        """The work: yields `Progress`, None when there is nothing to do before the next tick, or a result.

        Closing the generator cancels the job. No step may take longer than a tick (`TICK_BUDGET`).
        """
        raise NotImplementedError

    def subject(self, context: bpy.types.Context) -> int:
        """session_uid of the object that the job is about."""
        return 0

    def finish(self, context: bpy.types.Context, result: object) -> str:
        """What remains to do with the last result of `steps`; returns the sentence that is reported."""
        raise NotImplementedError

    def cancel_message(self, context: bpy.types.Context) -> str:
        """The sentence that is reported when the user has cancelled the job."""
        return f"{self.title} canceled."

    def on_failure(self) -> None:
        """Do what remains when the job has ended with an error."""

    @classmethod
    def is_idle(cls) -> bool:
        """Whether no job runs; sets the poll message otherwise. For `poll`."""
        job = current()
        if job is not None:
            cls.poll_message_set(f"{job.title} is under way; wait for it or cancel it")
        return job is None

    @property
    def state(self) -> JobState:
        """The state of this operator's job, for its log and curves."""
        return self._run.state

    def execute(self, context: bpy.types.Context) -> set[str]:
        if not self._begin(context):
            return {"CANCELLED"}
        while not self._run.work(BACKGROUND_STEP_SECONDS):
            if self._run.is_waiting:
                time.sleep(BACKGROUND_STEP_SECONDS)
        return self._end()

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        if bpy.app.background or context.window is None:
            return self.execute(context)
        if not self._begin(context):
            return {"CANCELLED"}
        if (result := self._tick(context)) is not None:
            return result
        manager = context.window_manager
        seconds = TICK_SECONDS if self.borrows_scene else IDLE_TICK_SECONDS
        self._timer = manager.event_timer_add(seconds, window=context.window)
        manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if not self._run.state.is_running:
            # Ended by an undo or by another file.
            self._end_modal(context)
            return {"CANCELLED"}
        if event.type == "ESC" and self.borrows_scene:
            request_cancel()
        if event.type == "TIMER" or self._run.state.cancel_requested:
            result = self._tick(context)
            if result is not None:
                return result
        if event.type == "TIMER" or not self.borrows_scene or _is_view_event(context, event):
            # Not with RUNNING_MODAL: Blender would then not notice which region the mouse is in, and no button works.
            return {"PASS_THROUGH"}
        return {"RUNNING_MODAL"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender ends the operator: its window is closed, or Blender."""
        if self._run.state.is_running:
            stop(f"{self.title} ended with its window.")
        self._end_modal(context)

    def _begin(self, context: bpy.types.Context) -> bool:
        if (job := current()) is not None:
            self.report({"ERROR"}, f"{job.title} is under way; wait for it or cancel it.")
            return False
        try:
            state = JobState(self.verb, self.title, self.subject(context), self.borrows_scene)
        except FDDAError as error:
            self.report({"ERROR"}, str(error))
            return False
        self._timer, self._status_text, self._drawn_progress = None, None, None
        self._last_redraw, self._last_work = 0.0, time.monotonic()
        self._run = Run(
            state,
            self.steps(context),
            lambda result: self.finish(bpy.context, result),
            lambda: self.cancel_message(bpy.context),
            self.ends_itself,
        )
        return True

    def _tick(self, context: bpy.types.Context) -> set[str] | None:
        """Work a little; returns the operator's result once the job has ended."""
        budget = TICK_BUDGET
        if self.borrows_scene:
            budget = min(max(budget, time.monotonic() - self._last_work), MAX_BUDGET)
        try:
            has_ended = self._run.work(budget)
        except BaseException:
            self._end_modal(context)
            raise
        self._last_work = time.monotonic()
        if has_ended:
            self._end_modal(context)
            return self._end()
        state, now = self._run.state, time.monotonic()
        shown = (state.stage, state.done, len(state.log) + len(state.warnings), state.cancel_requested)
        if shown != self._drawn_progress and now - self._last_redraw >= REDRAW_SECONDS:
            self._drawn_progress, self._last_redraw = shown, now
            text = f"{self.title}: {state.sentence} (ESC: cancel)" if self.borrows_scene else None
            self._set_status_text(context, text)
            redraw()
        return None

    def _end(self) -> set[str]:
        """Report how the job ended; returns the operator's result."""
        state = self._run.state
        if state.outcome_level == "ERROR":
            self.on_failure()
        if self.changes_file:
            bpy.ops.ed.undo_push(message=self.title)
        self.report({state.outcome_level}, state.outcome)
        return {"FINISHED"} if state.outcome_level == "INFO" else {"CANCELLED"}

    def _set_status_text(self, context: bpy.types.Context, text: str | None) -> None:
        """Show a text in the status bar, or Blender's own again where one was shown."""
        if text != self._status_text and context.workspace is not None:
            context.workspace.status_text_set(text)
            self._status_text = text

    def _end_modal(self, context: bpy.types.Context) -> None:
        if self._timer is not None:
            context.window_manager.event_timer_remove(self._timer)
            self._timer = None
            self._set_status_text(context, None)


def _is_view_event(context: bpy.types.Context, event: bpy.types.Event) -> bool:
    """Whether an event may reach the rest of Blender while the scene is borrowed: to look, and to press Cancel."""
    if event.type in VIEW_EVENTS:
        return True
    # Not the strip of tabs at either side: on another tab there would be no way back.
    strip = TAB_STRIP_WIDTH * context.preferences.system.ui_scale
    return event.type == "LEFTMOUSE" and any(
        region.type == "UI"
        and region.active_panel_category == "FDDA"
        and strip <= event.mouse_x - region.x < region.width - strip
        and 0 <= event.mouse_y - region.y < region.height
        for area in context.screen.areas
        if area.type == "VIEW_3D"
        for region in area.regions
    )


class FDDA_OT_cancel(bpy.types.Operator):
    bl_idname = "fdda.cancel"
    bl_label = "Cancel"
    bl_description = "Cancel the running job. What it has finished is kept"
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        if current() is None:
            cls.poll_message_set("No job is running")
        return current() is not None

    def execute(self, _context: bpy.types.Context) -> set[str]:
        request_cancel()
        redraw()
        return {"FINISHED"}


CLASSES = (FDDA_OT_cancel,)

__all__ = ["CLASSES", "JobOperator", "unregister"]
