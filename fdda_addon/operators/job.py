# SPDX-License-Identifier: GPL-3.0-or-later
"""Base class of operators that run a job.

Invoked in a window, an operator iterates the job at each tick of a timer. In the background, or if it is executed, it
runs the job to its end.
"""

import time

import bpy

from ..core.errors import FDDAError
from ..core.progress import Job
from ..core.sentences.window import for_window
from ..jobs.job import JobRunner, current, redraw, request_cancel, stop, unregister
from ..jobs.state import JobState
from ..scene.blend_file import report_message
from .rig_operator import RigOperator

TICK_BUDGET, MAX_BUDGET = 0.03, 0.2
"""Shortest and longest time that a job may work in one tick, seconds. A tick does not interrupt a step.

Blender redraws the viewport after each tick of a job that changes the scene. If redrawing takes longer than
`TICK_BUDGET`, the job may work for the same time, so that at most half of the time is spent on redrawing.
"""
TICK_SECONDS, IDLE_TICK_SECONDS = 0.01, 0.1
"""Time between two ticks, seconds: for a job that changes the scene, and for one that waits for another process."""
BACKGROUND_STEP_SECONDS = 0.05
REDRAW_SECONDS = 0.1
TAB_STRIP_WIDTH = 24

VIEW_EVENTS = {"MOUSEMOVE", "INBETWEEN_MOUSEMOVE", "MIDDLEMOUSE", "WHEELUPMOUSE", "WHEELDOWNMOUSE", "WINDOW_DEACTIVATE"}
"""Events that a job passes on to Blender while it changes the scene: they navigate the view."""


class JobOperator(RigOperator):
    """Mixin for an operator that runs a job on a rig.

    A subclass sets `verb` and `title`, defines `steps` and `finish`, and may define `cancel_message`. FDDAErrors of
    these are reported, and the operator is canceled. An `invoke` that shows a dialog sets `is_confirming`: Blender then
    calls `execute`, which would block Blender until the job ends, so `execute` invokes the operator again.
    """

    bl_options = {"REGISTER"}
    waits_for_all_jobs = True
    is_confirming = False
    verb = ""
    title = ""
    changes_scene = True
    """Whether the job changes the scene and restores it. Meanwhile only the view can be navigated; ESC cancels."""
    changes_file = False
    """Whether the job changes data of the .blend file. If so, an undo step is added at its end."""
    ends_itself = False
    """Whether `steps` checks `state.cancel_requested` and ends by itself. Otherwise the generator is closed."""

    def steps(self, context: bpy.types.Context) -> Job[object]:
        """Run the job while the generator is iterated.

        Closing the generator cancels the job. A step should take less than `TICK_BUDGET`.
        """
        raise NotImplementedError

    def subject(self, context: bpy.types.Context) -> int:
        """Return the session_uid of the object that the job works on; 0 without one."""
        return self.rig(context).mesh_object.session_uid

    def finish(self, context: bpy.types.Context, result: object) -> str:
        """Process the result of `steps`, and return the message to report."""
        raise NotImplementedError

    def cancel_message(self, context: bpy.types.Context) -> str:
        """Return the message to report when the user has canceled the job."""
        return f"{self.title} canceled."

    def on_failure(self) -> None:
        """Clean up after an error."""

    @property
    def state(self) -> JobState:
        """Return the state of the job, for its warnings and curves."""
        return self._run.state

    def execute(self, context: bpy.types.Context) -> set[str]:
        if self.is_confirming:
            operator = getattr(bpy.ops.fdda, self.bl_idname.lower().rpartition("_ot_")[2])
            try:
                return operator("INVOKE_DEFAULT", **self.as_keywords())
            except RuntimeError as error:
                if "Traceback" in str(error):
                    raise
                # A job that fails at once has reported this.
                self.report({"ERROR"}, report_message(error))
                return {"CANCELLED"}
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
        seconds = TICK_SECONDS if self.changes_scene else IDLE_TICK_SECONDS
        self._timer = manager.event_timer_add(seconds, window=context.window)
        manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if not self._run.state.is_running:
            # An undo or another file has ended the job.
            self._end_modal(context)
            return {"CANCELLED"}
        if event.type == "ESC" and self.changes_scene:
            request_cancel()
        if event.type == "S" and event.value == "PRESS" and (event.ctrl or event.oskey) and self.changes_scene:
            self.state.note = "Not saved: this job changes the scene. Save when it has ended, or press ESC."
            redraw()
        if event.type == "TIMER" or self._run.state.cancel_requested:
            result = self._tick(context)
            if result is not None:
                return result
        if event.type == "TIMER" or not self.changes_scene or _is_view_event(context, event):
            # With RUNNING_MODAL Blender would not track the region below the mouse, and no button would work.
            return {"PASS_THROUGH"}
        return {"RUNNING_MODAL"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Stop the job, because its window or Blender is closed."""
        if self.is_confirming:
            return
        if self._run.state.is_running:
            stop(f"{self.title} ended with its window.")
        self._end_modal(context)

    def _begin(self, context: bpy.types.Context) -> bool:
        if (job := current()) is not None:
            self.report({"ERROR"}, f"{job.busy_text}.")
            return False
        try:
            state = JobState(self.verb, self.title, self.subject(context), self.changes_scene)
        except FDDAError as error:
            self.report({"ERROR"}, str(error))
            return False
        self._timer, self._status_text, self._drawn_progress = None, None, None
        self._last_redraw, self._last_work = 0.0, time.monotonic()
        self._run = JobRunner(
            state,
            self.steps(context),
            lambda result: self.finish(bpy.context, result),
            lambda: self.cancel_message(bpy.context),
            self.ends_itself,
        )
        return True

    def _tick(self, context: bpy.types.Context) -> set[str] | None:
        """Work for one tick; return the result of the operator once the job has ended."""
        budget = TICK_BUDGET
        if self.changes_scene:
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
        progress = (state.stage, state.done, len(state.warnings), state.cancel_requested)
        if progress != self._drawn_progress and now - self._last_redraw >= REDRAW_SECONDS:
            self._drawn_progress, self._last_redraw = progress, now
            # If the user can work meanwhile, the status bar has Blender's hints.
            remaining = f", {state.remaining_text.lower()}" if state.remaining_seconds is not None else ""
            text = f"{self.title}: {state.sentence}{remaining} (ESC: cancel). {state.note}".rstrip(". ")
            self._set_status_text(context, text if self.changes_scene else None)
            redraw()
        return None

    def _end(self) -> set[str]:
        """Report the outcome of the job, and return the result of the operator."""
        state = self._run.state
        if state.outcome_level == "ERROR":
            self.on_failure()
        if self.changes_file:
            bpy.ops.ed.undo_push(message=self.title)
        self.report({state.outcome_level}, for_window(state.outcome))
        return {"FINISHED"} if state.outcome_level == "INFO" else {"CANCELLED"}

    def _set_status_text(self, context: bpy.types.Context, text: str | None) -> None:
        """Show a text in the status bar; None restores Blender's own."""
        if text == self._status_text or context.workspace is None:
            return
        context.workspace.status_text_set(text)
        self._status_text = text

    def _end_modal(self, context: bpy.types.Context) -> None:
        if self._timer is not None:
            context.window_manager.event_timer_remove(self._timer)
            self._timer = None
            self._set_status_text(context, None)


def _is_view_event(context: bpy.types.Context, event: bpy.types.Event) -> bool:
    """Return whether an event only navigates the view or presses a button of the sidebar, such as Cancel."""
    if event.type in VIEW_EVENTS:
        return True
    # Clicks on the tabs are blocked: there would be no way back from another tab.
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


class FileJobOperator(JobOperator):
    """Mixin for a job operator that writes the file `filepath`, and shows a file browser if that is empty."""

    filepath: str
    check_existing: bpy.props.BoolProperty(default=True, options={"HIDDEN"})

    def suggested_path(self, context: bpy.types.Context) -> str:
        """Return the file that the browser suggests; `//` stands for the folder of the .blend file.

        Raises:
            FDDAError: the operator cannot run; there is nothing to choose.
        """
        raise NotImplementedError

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if self.filepath:
            return super().invoke(context, event)
        try:
            self.filepath = bpy.path.abspath(self.suggested_path(context))
        except FDDAError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.is_confirming = True
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}


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
