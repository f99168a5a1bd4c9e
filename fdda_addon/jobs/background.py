# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs background jobs, which wait for other processes and use no data of Blender.

A timer iterates them. A modal operator would end when its window, such as the preferences, is closed.
"""

import queue
import threading
from collections.abc import Callable

import bpy

from ..core.progress import Job, Progress, Result
from .job import current_runner, redraw
from .state import ENVIRONMENT, JobState

TICK_SECONDS, TICK_WORK_SECONDS = 0.2, 0.02
THREAD_JOIN_SECONDS = 10.0
"""Longest time to wait for the end of a canceled thread."""


def iterate_in_thread(job: Job[Result], state: JobState, cancel: Callable[[], None] | None = None) -> Job[Result]:
    """Iterate a job in a thread, because it blocks; it must not use data of Blender.

    Args:
        state: state of the job, whose `cancel_requested` is checked.
        cancel: thread-safe function that makes `job` end soon; None if it cannot be canceled.

    Raises:
        BaseException: the exception that `job` has raised.
    """
    steps: queue.SimpleQueue[Progress | BaseException | None] = queue.SimpleQueue()

    def work() -> None:
        try:
            while True:
                steps.put(next(job))
        except BaseException as error:  # Raised again in the main thread.
            steps.put(error)

    thread = threading.Thread(target=work, name=f"FDDA: {state.title}", daemon=True)
    thread.start()
    is_cancel_sent = False
    try:
        while True:
            if state.cancel_requested and cancel and not is_cancel_sent:
                is_cancel_sent = True
                cancel()
            try:
                step = steps.get_nowait()
            except queue.Empty:
                yield None
                continue
            if isinstance(step, StopIteration):
                return step.value
            if isinstance(step, BaseException):
                raise step
            yield step
    finally:
        if cancel and thread.is_alive():
            cancel()
        thread.join(THREAD_JOIN_SECONDS)


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
