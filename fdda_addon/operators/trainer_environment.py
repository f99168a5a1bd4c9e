# SPDX-License-Identifier: GPL-3.0-or-later
"""The operators of the trainer's Python: check it, create the add-on's own environment, cancel that, remove it.

Pressed in a window they work in a thread and a timer looks after it: unlike a modal operator it does not end with the
preferences' window. Executed, or without a window, they work to their end.
"""

from collections.abc import Callable, Generator
from pathlib import Path

import bpy
from bpy.props import StringProperty

from ..core.errors import FDDAError, TrainerEnvironmentError
from ..core.progress import Progress
from ..preferences import wheels_folder
from ..trainer_environment import choice, folder, session
from ..trainer_environment.answer import Answer

TICK_SECONDS = 0.2
_Work = tuple[Generator[Progress | Answer], Callable[[], None] | None]
"""The steps, and what has them end soon."""


class _Task:
    """Mixin: one task at a time, in a thread when a window waits for it."""

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        if session.task is not None:
            cls.poll_message_set(f"{session.task.title} is under way; wait for it or cancel it")
        return session.task is None

    def steps(self) -> _Work:
        """The work. FDDAError: it cannot begin."""
        raise NotImplementedError

    @staticmethod
    def keep(outcome: Answer) -> None:
        """Have the outcome shown."""
        session.remember(None, outcome)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        if bpy.app.background or context.window is None:
            return self.execute(context)
        try:
            steps, cancel = self.steps()
        except FDDAError as error:
            return self._end(Answer("ERROR", str(error)))
        # The class's: the operator is gone when the task ends.
        session.start(session.Task(self.bl_label, steps, cancel, type(self).keep))
        if not bpy.app.timers.is_registered(_watch):
            bpy.app.timers.register(_watch, first_interval=TICK_SECONDS, persistent=True)
        return {"FINISHED"}

    def execute(self, _context: bpy.types.Context) -> set[str]:
        outcome = Answer("ERROR", f"{self.bl_label} ended without a word.")
        try:
            steps, _cancel = self.steps()
            for step in steps:
                if isinstance(step, Answer):
                    outcome = step
                else:
                    print(f"{self.bl_label}: {step.stage}")
        except FDDAError as error:
            outcome = Answer("ERROR", str(error))
        return self._end(outcome)

    def _end(self, outcome: Answer) -> set[str]:
        self.keep(outcome)
        self.report({outcome.level}, outcome.message)
        return {"CANCELLED"} if outcome.level == "ERROR" else {"FINISHED"}


class FDDA_OT_check_trainer(_Task, bpy.types.Operator):
    bl_idname = "fdda.check_trainer"
    bl_label = "Check the Trainer's Python"
    bl_description = "Ask the Python that trains for its version, torch and the device that it would train on"

    def steps(self) -> _Work:
        return _check(choice.chosen_python()), None

    @staticmethod
    def keep(outcome: Answer) -> None:
        session.remember(outcome)


def _check(python: choice.TrainerPython) -> Generator[Progress | Answer]:
    yield Progress(f"asking '{python.path}'", 0, 0)
    yield choice.ping(python)


class FDDA_OT_create_trainer_environment(_Task, bpy.types.Operator):
    bl_idname = "fdda.create_trainer_environment"
    bl_label = "Create Trainer Environment"
    bl_description = (
        "Make a Python environment with torch in the add-on's own folder, in the background. It takes some minutes, on "
        "Linux 3 GB to download and 6 GB of disk"
    )

    python: StringProperty(
        name="Python", description="The Python to make it from; empty: one that is found", options={"SKIP_SAVE"}
    )
    wheels: StringProperty(
        name="Wheels",
        description="Folder of wheels to install from; empty: that of the preferences, else the package index",
        options={"SKIP_SAVE"},
    )

    def steps(self) -> _Work:
        from ..trainer_environment.creation import Creation

        wheels = self.wheels or wheels_folder()
        if reason := folder.obstacle(wheels):
            raise TrainerEnvironmentError(f"{reason}.")
        path = Path(bpy.path.abspath(wheels)) if wheels else None
        creation = Creation(folder.own_folder(), folder.log_path(), path, self.python)
        return creation.steps(), creation.cancel

    @staticmethod
    def keep(outcome: Answer) -> None:
        origin = choice.chosen_python().origin
        if outcome.level != "INFO":
            session.remember(None, outcome)
        elif origin is choice.Origin.OWN:
            session.remember(outcome)
        else:
            what = "the field Python" if origin is choice.Origin.PREFERENCES else choice.PYTHON_VARIABLE
            text = f"The trainer environment is ready, but {what} names another Python, which is used in its place."
            session.remember(None, Answer("WARNING", text))


class FDDA_OT_remove_trainer_environment(_Task, bpy.types.Operator):
    bl_idname = "fdda.remove_trainer_environment"
    bl_label = "Remove Trainer Environment"
    bl_description = "Remove the Python environment that the add-on has made, some gigabytes"

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if bpy.app.background or context.window is None:
            return self.execute(context)
        return context.window_manager.invoke_confirm(self, event)

    def steps(self) -> _Work:
        return _remove(folder.own_folder()), None


def _remove(path: Path) -> Generator[Progress | Answer]:
    yield Progress(f"removing '{path}'", 0, 0)
    with folder.claimed(path):
        existed = path.exists()
        folder.remove(path)
    yield Answer("INFO", "The trainer environment was removed." if existed else "There is no trainer environment.")


class FDDA_OT_cancel_trainer_environment(bpy.types.Operator):
    bl_idname = "fdda.cancel_trainer_environment"
    bl_label = "Cancel"
    bl_description = "End the creation of the trainer environment; nothing is left of it"
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        if session.task is None or not session.task.can_cancel:
            cls.poll_message_set("Nothing is under way")
            return False
        return True

    def execute(self, _context: bpy.types.Context) -> set[str]:
        session.task.cancel()
        return {"FINISHED"}


class FDDA_OT_open_trainer_log(bpy.types.Operator):
    bl_idname = "fdda.open_trainer_log"
    bl_label = "Open Log"
    bl_description = "Show what the last creation of the trainer environment printed"
    bl_options = {"INTERNAL"}

    def execute(self, _context: bpy.types.Context) -> set[str]:
        log = folder.log_path()
        if not log.is_file():
            self.report({"ERROR"}, f"There is no log '{log}' yet; it is written when the environment is created.")
            return {"CANCELLED"}
        return bpy.ops.wm.path_open(filepath=str(log))


def _watch() -> float | None:
    """Timer: have the task drawn while it runs, and keep its outcome."""
    outcome = session.end_task()
    if outcome is not None:
        print(f"FDDA: {outcome.message}")
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in ("PREFERENCES", "VIEW_3D"):
                area.tag_redraw()
    return TICK_SECONDS if session.task is not None else None


CLASSES = (
    FDDA_OT_check_trainer,
    FDDA_OT_create_trainer_environment,
    FDDA_OT_remove_trainer_environment,
    FDDA_OT_cancel_trainer_environment,
    FDDA_OT_open_trainer_log,
)
