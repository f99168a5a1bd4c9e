# SPDX-License-Identifier: GPL-3.0-or-later
"""Background jobs: they run in a thread, beside another job and across opened files, and end with the add-on."""

import threading
import time
from collections.abc import Callable, Iterator

import bpy
import pytest

import fdda_addon
from fdda_addon.core.errors import FDDAError
from fdda_addon.core.progress import Job, Progress
from fdda_addon.jobs import background
from fdda_addon.jobs.background import iterate_in_thread, run_in_background
from fdda_addon.jobs.job import JobRunner, current, request_cancel, state_of
from fdda_addon.jobs.state import CHARACTER, ENVIRONMENT, JobState


class ControlledWork:
    """Work of a job that waits until `go` is set, and stops when `canceled` is set."""

    def __init__(self, error: BaseException | None = None):
        self.go, self.canceled, self.threads, self.error = threading.Event(), threading.Event(), set(), error

    def steps(self) -> Job[str]:
        self.threads.add(threading.current_thread())
        yield Progress("waiting", 0, 2)
        while not self.go.wait(0.005):
            if self.canceled.is_set():
                raise FDDAError("It was canceled; nothing is left of it.")
        if self.error:
            raise self.error
        yield Progress("going", 1, 2)
        return "done"

    def start_job(self) -> JobRunner:
        state = JobState("fetch", "Fetching", works_on=ENVIRONMENT)
        steps = iterate_in_thread(self.steps(), state, self.canceled.set)
        return JobRunner(state, steps, lambda result: f"Fetched: {result}.", lambda: "Cancelled.", ends_itself=True)


@pytest.fixture
def work() -> Iterator[ControlledWork]:
    work = ControlledWork()
    yield work
    work.canceled.set()


def wait_until(condition: Callable[[], object], seconds: float = 20.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_a_background_job_runs_in_a_thread_without_blocking(work):
    run = work.start_job()
    start = time.monotonic()
    wait_until(lambda: not run.work(0.01) and run.state.stage == "waiting")
    assert not run.work(1) and run.is_waiting and time.monotonic() - start < 5
    assert threading.main_thread() not in work.threads
    work.go.set()
    wait_until(lambda: run.work(0.01))
    state = state_of("fetch")
    assert (state.stage, state.done, state.outcome, state.outcome_level) == ("going", 1, "Fetched: done.", "INFO")
    assert current(ENVIRONMENT) is None and not next(iter(work.threads)).is_alive()


def test_a_background_job_continues_beside_another_job_and_after_another_file_is_opened(work):
    background_run, run = work.start_job(), JobRunner(JobState("count", "Counting"), (step for step in ()), str, str)
    assert current(CHARACTER) is run.state and current(ENVIRONMENT) is background_run.state
    background_run.work(0)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    assert current(CHARACTER) is None and run.state.outcome == "Counting ended because another file was opened."
    assert current(ENVIRONMENT) is background_run.state and not background_run.work(0)
    work.go.set()
    wait_until(lambda: background_run.work(0.01))
    assert background_run.state.outcome_level == "INFO"


def test_the_outcome_of_a_canceled_job_is_its_own_message(work):
    run = work.start_job()
    assert not run.work(0)
    request_cancel()
    assert not run.state.cancel_requested, "only jobs on characters are canceled"
    request_cancel(ENVIRONMENT)
    wait_until(lambda: run.work(0.01))
    assert (run.state.outcome, run.state.outcome_level) == ("It was canceled; nothing is left of it.", "WARNING")


def test_an_expected_error_is_the_outcome_and_another_error_is_raised():
    failing, broken = ControlledWork(FDDAError("The disk is full.")), ControlledWork(ZeroDivisionError("a bug"))
    for work in (failing, broken):
        work.go.set()
    run = failing.start_job()
    wait_until(lambda: run.work(0.01))
    assert (run.state.outcome, run.state.outcome_level) == ("The disk is full.", "ERROR")
    run = broken.start_job()
    with pytest.raises(ZeroDivisionError):
        wait_until(lambda: run.work(0.01))
    assert run.state.outcome == "Fetching failed; see the system console." and current(ENVIRONMENT) is None


def test_a_timer_runs_a_background_job_to_its_end(work, capsys):
    run = work.start_job()
    run_in_background()
    assert bpy.app.timers.is_registered(background._tick)
    bpy.app.timers.unregister(background._tick)
    assert background._tick() == background.TICK_SECONDS
    work.go.set()
    wait_until(lambda: background._tick() is None)
    assert run.state.outcome == "Fetched: done." and capsys.readouterr().out == "FDDA: Fetched: done.\n"
    assert background._tick() is None


def test_disabling_the_add_on_ends_a_background_job(work):
    run = work.start_job()
    run_in_background()
    assert not run.work(0)
    fdda_addon.unregister()
    assert work.canceled.is_set() and not next(iter(work.threads)).is_alive()
    assert run.state.outcome == "Fetching ended because the add-on was disabled."
    assert not bpy.app.timers.is_registered(background._tick)
