# SPDX-License-Identifier: GPL-3.0-or-later
"""Background jobs, which wait for other processes and use no data of Blender.

A timer runs them, because a modal operator would end with its window, such as the preferences.
"""

import queue
import threading
from collections.abc import Callable, Iterator

import bpy

from .job import ENVIRONMENT, JobRunner, JobState, current, redraw

TICK_SECONDS, TICK_WORK_SECONDS = 0.2, 0.02
THREAD_JOIN_SECONDS = 10.0
"""Time to wait for a thread that was asked to end."""

_run: JobRunner | None = None


def iterate_in_thread(
    steps: Iterator[object], state: JobState, cancel: Callable[[], None] | None = None
) -> Iterator[object]:
    """Iterate `steps` in a thread, for work that blocks and uses no data of Blender.

    Args:
        steps: the work.
        state: of the job, which may request its cancellation.
        cancel: thread-safe function that ends `steps` soon; None where that is not possible.

    Yields:
        The values of `steps`, None while there is none.

    Raises:
        BaseException: as `steps`.
    """
    results: queue.SimpleQueue[tuple[object, BaseException | None]] = queue.SimpleQueue()

    def work() -> None:
        try:
            for step in steps:
                results.put((step, None))
            results.put((None, StopIteration()))
        except BaseException as error:  # Raised again in the main thread.
            results.put((None, error))

    thread = threading.Thread(target=work, name=f"FDDA: {state.title}", daemon=True)
    thread.start()
    is_cancel_sent = False
    try:
        while True:
            if state.cancel_requested and cancel and not is_cancel_sent:
                is_cancel_sent = True
                cancel()
            try:
                step, error = results.get_nowait()
            except queue.Empty:
                yield None
                continue
            if isinstance(error, StopIteration):
                return
            if error is not None:
                raise error
            yield step
    finally:
        if cancel and thread.is_alive():
            cancel()
        thread.join(THREAD_JOIN_SECONDS)


def run_in_background(run: JobRunner) -> None:
    """Iterate a job on the training environment until it ends, independent of windows and files."""
    global _run
    _run = run
    if not bpy.app.timers.is_registered(_tick):
        bpy.app.timers.register(_tick, first_interval=TICK_SECONDS, persistent=True)


def unregister() -> None:
    """Remove the timer; `job.unregister` ends the job."""
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)


def _tick() -> float | None:
    if current(ENVIRONMENT) is None:
        # The job was stopped.
        return None
    if _run.work(TICK_WORK_SECONDS):
        print(f"FDDA: {_run.state.outcome}")
        return None
    redraw()
    return TICK_SECONDS
