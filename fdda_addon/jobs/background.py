# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs background jobs, which wait for other processes and use no data of Blender.

A timer iterates them. A modal operator would end when its window, such as the preferences, is closed.
"""

import threading
from collections.abc import Callable

import bpy

from ..core.progress import Job, Result, run_job
from .job import current_runner, redraw
from .state import ENVIRONMENT, JobState

TICK_SECONDS, TICK_WORK_SECONDS = 0.2, 0.02
THREAD_JOIN_SECONDS = 10.0
"""Longest time to wait for the end of a canceled thread."""


def iterate_in_thread(job: Job[Result], state: JobState, cancel: Callable[[], None] | None = None) -> Job[Result]:
    """Iterate a job in a thread, because it blocks; it must not use data of Blender.

    Args:
        state: state of the job. The thread shows the progress in it.
        cancel: thread-safe function that makes `job` end soon; None if it cannot be canceled.

    Raises:
        BaseException: the exception that `job` has raised.
    """
    outcomes: list[Result | BaseException] = []

    def work() -> None:
        try:
            outcomes.append(run_job(job, state.show))
        except BaseException as error:  # Raised again in the main thread.
            outcomes.append(error)

    thread = threading.Thread(target=work, name=f"FDDA: {state.title}", daemon=True)
    thread.start()
    try:
        while thread.is_alive() and not (state.cancel_requested and cancel):
            yield None
        if thread.is_alive():
            cancel, cancel_job = None, cancel
            cancel_job()
        while thread.is_alive():
            yield None
    finally:
        if cancel and thread.is_alive():
            cancel()
        thread.join(THREAD_JOIN_SECONDS)
    if isinstance(outcomes[0], BaseException):
        raise outcomes[0]
    return outcomes[0]


def run_in_background() -> None:
    """Start to iterate the job on the training environment; it continues when windows are closed and files opened."""
    if not bpy.app.timers.is_registered(_tick):
        bpy.app.timers.register(_tick, first_interval=TICK_SECONDS, persistent=True)


def unregister() -> None:
    """Remove the timer; `job.unregister` ends the job."""
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)


def _tick() -> float | None:
    runner = current_runner(ENVIRONMENT)
    if runner is None:
        # The job was stopped.
        return None
    if runner.work(TICK_WORK_SECONDS):
        print(f"FDDA: {runner.state.outcome}")
        return None
    redraw()
    return TICK_SECONDS
