# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs that go on by themselves: in a thread, beside another job, through other files, and not without an end."""

import threading
import time
from collections.abc import Callable, Iterator

import bpy
import pytest

import fdda_addon
from fdda_addon.core.errors import FDDAError
from fdda_addon.core.progress import Progress
from fdda_addon.jobs import background
from fdda_addon.jobs.background import iterate_in_thread, run_in_background
from fdda_addon.jobs.job import CHARACTER, ENVIRONMENT, JobRunner, JobState, current, request_cancel, state_of


class Work:
    """Steps that wait for `go`, one after the other, and end when `cancel` is called."""

    def __init__(self, error: BaseException | None = None):
        self.go, self.canceled, self.threads, self.error = threading.Event(), threading.Event(), set(), error

    def steps(self) -> Iterator[object]:
        self.threads.add(threading.current_thread())
        yield Progress("waiting", 0, 2)
        while not self.go.wait(0.005):
            if self.canceled.is_set():
                raise FDDAError("It was canceled; nothing is left of it.")
        if self.error:
            raise self.error
        yield Progress("going", 1, 2)
        yield "done"

    def begin(self) -> JobRunner:
        state = JobState("fetch", "Fetching", works_on=ENVIRONMENT)
        steps = iterate_in_thread(self.steps(), state, self.canceled.set)
        return JobRunner(state, steps, lambda result: f"Fetched: {result}.", lambda: "Cancelled.", ends_itself=True)


@pytest.fixture
def work() -> Iterator[Work]:
    work = Work()
    yield work
    work.canceled.set()


def until(condition: Callable[[], object], seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def test_it_works_in_a_thread_and_never_waits(work):
    run = work.begin()
    began = time.monotonic()
    until(lambda: not run.work(0.01) and run.state.stage == "waiting")
    assert not run.work(1) and run.is_waiting and time.monotonic() - began < 5
    assert threading.main_thread() not in work.threads
    work.go.set()
    until(lambda: run.work(0.01))
    state = state_of("fetch")
    assert (state.stage, state.done, state.outcome, state.outcome_level) == ("going", 1, "Fetched: done.", "INFO")
    assert current(ENVIRONMENT) is None and not next(iter(work.threads)).is_alive()


def test_it_goes_on_beside_a_job_on_a_character_and_through_another_file(work):
    beside, run = work.begin(), JobRunner(JobState("count", "Counting"), (step for step in ()), str, str)
    assert current(CHARACTER) is run.state and current(ENVIRONMENT) is beside.state
    beside.work(0)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    assert current(CHARACTER) is None and run.state.outcome == "Counting ended because another file was opened."
    assert current(ENVIRONMENT) is beside.state and not beside.work(0)
    work.go.set()
    until(lambda: beside.work(0.01))
    assert beside.state.outcome_level == "INFO"


def test_cancelled_it_says_so_itself(work):
    run = work.begin()
    assert not run.work(0)
    request_cancel()
    assert not run.state.cancel_requested, "that was about the other job"
    request_cancel(ENVIRONMENT)
    until(lambda: run.work(0.01))
    assert (run.state.outcome, run.state.outcome_level) == ("It was canceled; nothing is left of it.", "WARNING")


def test_an_error_is_its_outcome_and_a_bug_is_raised():
    failing, broken = Work(FDDAError("The disk is full.")), Work(ZeroDivisionError("a bug"))
    for work in (failing, broken):
        work.go.set()
    run = failing.begin()
    until(lambda: run.work(0.01))
    assert (run.state.outcome, run.state.outcome_level) == ("The disk is full.", "ERROR")
    run = broken.begin()
    with pytest.raises(ZeroDivisionError):
        until(lambda: run.work(0.01))
    assert run.state.outcome == "Fetching failed; see the system console." and current(ENVIRONMENT) is None


def test_a_timer_looks_after_it(work, capsys):
    run = work.begin()
    run_in_background(run)
    assert bpy.app.timers.is_registered(background._tick)
    bpy.app.timers.unregister(background._tick)
    assert background._tick() == background.TICK_SECONDS
    work.go.set()
    until(lambda: background._tick() is None)
    assert run.state.outcome == "Fetched: done." and capsys.readouterr().out == "FDDA: Fetched: done.\n"
    assert background._tick() is None


def test_it_ends_with_the_addon(work):
    run = work.begin()
    run_in_background(run)
    assert not run.work(0)
    fdda_addon.unregister()
    assert work.canceled.is_set() and not next(iter(work.threads)).is_alive()
    assert run.state.outcome == "Fetching ended because the add-on was disabled."
    assert not bpy.app.timers.is_registered(background._tick)
