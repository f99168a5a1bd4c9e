# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators on the Python for training: check it; install and remove the training environment.

Invoked in a window, an operator runs in the background (`jobs.background`). If it is executed, it runs to its end.
"""

import time
from collections.abc import Callable
from pathlib import Path

import bpy
from bpy.props import StringProperty

from ..core.errors import FDDAError, TrainerEnvironmentError
from ..core.progress import Job, Progress
from ..jobs.background import iterate_in_thread, run_in_background, unregister
from ..jobs.job import JobRunner, current, request_cancel
from ..jobs.state import ENVIRONMENT, JobState
from ..properties.preferences import wheels_folder
from ..training.environment import choice, folder, session
from ..training.environment.check import CheckResult
from ..training.environment.creation import EnvironmentCreation

WAIT_SECONDS = 0.05
_EnvironmentJob = tuple[Job[CheckResult], Callable[[], None] | None]
"""A job, and a function that cancels it; None if it cannot be canceled."""


class _EnvironmentOperator:
    """Mixin for an operator with a job on the training environment, which runs in a thread."""

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        if (state := current(ENVIRONMENT)) is not None:
            cls.poll_message_set(state.busy_text)
            return False
        return True

    def steps(self) -> _EnvironmentJob:
        """Return the job, and the function that cancels it.

        Raises:
            FDDAError: the job cannot start.
        """
        raise NotImplementedError

    @staticmethod
    def store_result(outcome: CheckResult) -> None:
        """Store the result of the job, which the preferences then show."""
        session.store_result(None, outcome)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        if bpy.app.background or context.window is None:
            return self.execute(context)
        if self._begin() is None:
            return {"CANCELLED"}
        # Blender frees the operator before the job ends, so the job must not refer to it.
        run_in_background()
        return {"FINISHED"}

    def execute(self, _context: bpy.types.Context) -> set[str]:
        if (runner := self._begin()) is None:
            return {"CANCELLED"}
        printed_stage = ""
        while not runner.work(WAIT_SECONDS):
            if runner.state.stage != printed_stage:
                printed_stage = runner.state.stage
                print(f"{self.bl_label}: {printed_stage}")
            time.sleep(WAIT_SECONDS)
        self.report({runner.state.outcome_level}, runner.state.outcome)
        return {"FINISHED"} if runner.state.outcome_level == "INFO" else {"CANCELLED"}

    def _begin(self) -> JobRunner | None:
        """Start the job; return None if it cannot start, which is reported and stored."""
        try:
            job, cancel = self.steps()
        except FDDAError as error:
            self.store_result(CheckResult("ERROR", str(error)))
            self.report({"ERROR"}, str(error))
            return None
        return start_job(self.bl_idname.partition("_OT_")[2], self.bl_label, job, cancel, type(self).store_result)


def start_job(
    verb: str,
    title: str,
    job: Job[CheckResult],
    cancel: Callable[[], None] | None,
    store_result: Callable[[CheckResult], None],
) -> JobRunner:
    """Start a job on the training environment.

    Args:
        verb, title: attributes of its `JobState`.
        job: the job. A thread iterates it.
        cancel: thread-safe function that makes `job` end soon; None if the job cannot be canceled.
        store_result: called in the main thread with the result.
    """
    state = JobState(verb, title, works_on=ENVIRONMENT, can_cancel=cancel is not None)

    def job_in_thread() -> Job[CheckResult]:
        try:
            return (yield from iterate_in_thread(job, state, cancel))
        except FDDAError as error:
            return CheckResult("WARNING" if state.cancel_requested else "ERROR", str(error))

    def finish(outcome: CheckResult) -> str:
        store_result(outcome)
        if outcome.level != "INFO":
            raise TrainerEnvironmentError(outcome.message)
        return outcome.message

    return JobRunner(state, job_in_thread(), finish, lambda: f"{title} was canceled.", ends_itself=True)


class FDDA_OT_check_trainer(_EnvironmentOperator, bpy.types.Operator):
    bl_idname = "fdda.check_trainer"
    bl_label = "Check Training Setup"
    bl_description = "Check whether the Python for training has PyTorch, and show which device it will train on"

    def steps(self) -> _EnvironmentJob:
        return _check(choice.select_python()), None

    @staticmethod
    def store_result(outcome: CheckResult) -> None:
        session.store_result(outcome)


def _check(python: choice.TrainerPython) -> Job[CheckResult]:
    yield Progress(f"asking '{python.path}'", 0, 0)
    return choice.check_trainer_python(python)


class FDDA_OT_create_trainer_environment(_EnvironmentOperator, bpy.types.Operator):
    bl_idname = "fdda.create_trainer_environment"
    bl_label = "Install Training Environment"
    bl_description = (
        "Install PyTorch into the add-on's own folder, in the background. This takes some minutes. On Linux it "
        "downloads 3 GB and uses 6 GB of disk space"
    )

    wheels: StringProperty(
        name="Offline Packages",
        description="Folder of .whl files to install from. Empty for the folder in the preferences",
        options={"SKIP_SAVE"},
    )

    def steps(self) -> _EnvironmentJob:
        wheels = self.wheels or wheels_folder()
        if reason := folder.creation_obstacle(wheels):
            raise TrainerEnvironmentError(f"{reason}.")
        path = Path(bpy.path.abspath(wheels)) if wheels else None
        creation = EnvironmentCreation(folder.environment_folder(), folder.log_path(), path)
        return creation.steps(), creation.cancel

    @staticmethod
    def store_result(outcome: CheckResult) -> None:
        origin = choice.select_python().origin
        if outcome.level != "INFO":
            session.store_result(None, outcome)
        elif origin is choice.Origin.OWN:
            session.store_result(outcome)
        else:
            field = "Existing Python" if origin is choice.Origin.PREFERENCES else choice.PYTHON_VARIABLE
            text = f"The training environment is ready, but {field} names another Python, which is used instead."
            session.store_result(None, CheckResult("WARNING", text))


class FDDA_OT_remove_trainer_environment(_EnvironmentOperator, bpy.types.Operator):
    bl_idname = "fdda.remove_trainer_environment"
    bl_label = "Remove Training Environment"
    bl_description = "Delete the Python environment that the add-on has installed"

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if bpy.app.background or context.window is None:
            return self.execute(context)
        return context.window_manager.invoke_confirm(self, event)

    def steps(self) -> _EnvironmentJob:
        return _remove(folder.environment_folder()), None


def _remove(path: Path) -> Job[CheckResult]:
    yield Progress(f"removing '{path}'", 0, 0)
    with folder.creation_lock(path):
        existed = path.exists()
        folder.remove_environment(path)
    return CheckResult(
        "INFO", "The training environment was removed." if existed else "There is no training environment."
    )


class FDDA_OT_cancel_trainer_environment(bpy.types.Operator):
    bl_idname = "fdda.cancel_trainer_environment"
    bl_label = "Cancel"
    bl_description = "Cancel the installation of the training environment. Nothing is kept"
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        state = current(ENVIRONMENT)
        if state is None or not state.can_cancel:
            cls.poll_message_set("No installation is running")
            return False
        return True

    def execute(self, _context: bpy.types.Context) -> set[str]:
        request_cancel(ENVIRONMENT)
        return {"FINISHED"}


CLASSES = (
    FDDA_OT_check_trainer,
    FDDA_OT_create_trainer_environment,
    FDDA_OT_remove_trainer_environment,
    FDDA_OT_cancel_trainer_environment,
)

__all__ = ["CLASSES", "start_job", "unregister"]
