# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs that go on by themselves: they wait for other processes, and touch no data of Blender's.

A timer looks after them: unlike a modal operator it does not end with its window, that of the preferences for instance.
"""

import queue
import threading
from collections.abc import Callable, Iterator

import bpy

from .job import ENVIRONMENT, JobRunner, JobState, current, redraw

TICK_SECONDS, TICK_WORK_SECONDS = 0.2, 0.02
THREAD_JOIN_SECONDS = 10.0
"""A thread that was asked to end is left to itself after so long."""

_run: JobRunner | None = None


def iterate_in_thread(
    steps: Iterator[object], state: JobState, cancel: Callable[[], None] | None = None
) -> Iterator[object]:
    """Iterate `steps` in a thread of its own: for what blocks, and touches no data of Blender's.

    Args:
        steps: the work.
        state: of its job; when it is to be cancelled, `steps` is.
        cancel: has `steps` end soon, called from another thread; None where that is not possible.

    Yields:
        What `steps` yields, None while there is nothing. It raises what `steps` raises.
    """
    results: queue.SimpleQueue[tuple[object, BaseException | None]] = queue.SimpleQueue()

    def work() -> None:
        try:
            for step in steps:
                results.put((step, None))
            results.put((None, StopIteration()))
        except BaseException as error:  # Not lost: it is raised where the job is looked after.
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
    """Iterate a job on the trainer's environment until it ends, whatever happens to windows and files."""
    global _run
    _run = run
    if not bpy.app.timers.is_registered(_tick):
        bpy.app.timers.register(_tick, first_interval=TICK_SECONDS, persistent=True)


def unregister() -> None:
    """Look after nothing any more; `job.unregister` ends the job."""
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)


def _tick() -> float | None:
    if current(ENVIRONMENT) is None:
        # It was ended from outside.
        return None
    if _run.work(TICK_WORK_SECONDS):
        print(f"FDDA: {_run.state.outcome}")
        return None
    redraw()
    return TICK_SECONDS
