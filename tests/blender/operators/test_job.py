# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs without a window: one on a character and one on the environment at a time; each ends with a message."""

import threading
import time
from collections.abc import Callable, Iterator

import bpy
import pytest

import fdda_addon
from fdda_addon.core.errors import FDDAError
from fdda_addon.core.progress import Job, Progress
from fdda_addon.jobs import background, job
from fdda_addon.jobs.background import iterate_in_thread, run_in_background
from fdda_addon.jobs.job import JobRunner, current, request_cancel, state_of
from fdda_addon.jobs.state import CHARACTER, ENVIRONMENT, JobState
from fdda_addon.operators.job import JobOperator

events: list[str] = []


class FDDA_OT_count(JobOperator, bpy.types.Operator):  # noqa: N801 - Blender wants it
    """Counts to `upto`; at the number `at` it does what `what` names, such as to fail."""

    bl_idname = "fdda.count"
    bl_label = "Count"
    verb, title = "count", "Counting"

    upto: bpy.props.IntProperty(default=3)
    at: bpy.props.IntProperty(default=-1)
    what: bpy.props.StringProperty()
    keep: bpy.props.BoolProperty(description="Keep the result in the file")

    @classmethod
    def poll_problem(cls, _context: bpy.types.Context) -> str:
        state = job.current()
        return state.busy_text if state else ""

    def subject(self, _context: bpy.types.Context) -> int:
        return 0

    def execute(self, context: bpy.types.Context) -> set[str]:
        if self.what.startswith("confirm "):
            self.what, self.is_confirming = self.what.removeprefix("confirm "), True
        return super().execute(context)

    def steps(self, _context: bpy.types.Context) -> Iterator[object]:
        try:
            for number in range(self.upto):
                if number == self.at:
                    yield from self._misbehave()
                yield Progress("numbers", number + 1, self.upto)
            return sum(range(self.upto))
        finally:
            events.append("given back")

    def _misbehave(self) -> Iterator[None]:
        if self.what == "fail":
            raise FDDAError("The number 1 is missing; count again.")
        if self.what == "cancel":
            bpy.ops.fdda.cancel()
        if self.what == "bug":
            raise ZeroDivisionError("a bug")
        if self.what == "second":
            bpy.ops.fdda.count()
        yield None

    def finish(self, _context: bpy.types.Context, result: object) -> str:
        events.append(f"finished with {result}")
        if self.keep:
            bpy.context.scene["counted"], self.changes_file = result, True
        return f"Counted to {result}."

    def cancel_message(self, _context: bpy.types.Context) -> str:
        return f"Counting canceled at {self.state.done}."


@pytest.fixture(autouse=True)
def _count(_addon: None) -> Iterator[None]:
    bpy.utils.register_class(FDDA_OT_count)
    events.clear()
    yield
    bpy.utils.unregister_class(FDDA_OT_count)


def test_without_a_window_a_job_runs_until_it_is_done():
    assert bpy.ops.fdda.count() == bpy.ops.fdda.count("INVOKE_DEFAULT") == {"FINISHED"}
    assert events == ["given back", "finished with 3"] * 2
    state = job.state_of("count")
    assert (state.done, state.total, state.stage, state.is_running) == (3, 3, "numbers", False)
    assert (state.outcome, state.outcome_level) == ("Counted to 3.", "INFO")
    assert job.current() is None


def test_a_job_that_changes_the_file_adds_an_undo_step_and_marks_the_file_as_changed():
    was_dirty = bpy.data.is_dirty
    bpy.ops.fdda.count()
    assert bpy.data.is_dirty is was_dirty
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.fdda.count(keep=True)
    assert bpy.data.is_dirty and bpy.context.scene["counted"] == 3
    bpy.ops.ed.undo()
    assert "counted" not in bpy.context.scene
    bpy.ops.ed.redo()
    assert bpy.context.scene["counted"] == 3


@pytest.mark.parametrize("what", ["fail", "confirm fail"])
def test_an_error_is_reported_and_cancels_the_operator(what):
    """Blender shows an exception of an operator that a dialog has called as a fault of the add-on."""
    with pytest.raises(RuntimeError) as caught:
        bpy.ops.fdda.count(at=1, what=what)
    assert str(caught.value).strip() == "Error: The number 1 is missing; count again."
    assert events == ["given back"]
    assert job.state_of("count").outcome_level == "ERROR" and job.current() is None
    assert bpy.ops.fdda.count() == {"FINISHED"}


def test_a_canceled_job_cleans_up_and_reports_its_progress():
    assert bpy.ops.fdda.count(at=2, what="cancel") == {"CANCELLED"}
    assert events == ["given back"]
    state = job.state_of("count")
    assert (state.outcome, state.outcome_level) == ("Counting canceled at 2.", "WARNING")


@pytest.mark.parametrize("what", ["bug", "confirm bug"])
def test_a_bug_propagates_and_does_not_block_the_next_job(what):
    with pytest.raises(RuntimeError, match="ZeroDivisionError"):
        bpy.ops.fdda.count(at=1, what=what)
    assert events == ["given back"] and job.current() is None


def test_there_is_one_job_at_a_time():
    with pytest.raises(RuntimeError, match="Counting is under way; wait for it or cancel it"):
        bpy.ops.fdda.count(at=1, what="second")


def test_cancel_without_a_job_says_so():
    with pytest.raises(RuntimeError, match="No job is running"):
        bpy.ops.fdda.cancel()


def under_way(changes_scene: bool) -> JobState:
    """Return the state of a job that is still running, between two timer events."""

    def steps() -> Iterator[Progress]:
        try:
            yield Progress("numbers", 1, 9)
            yield Progress("numbers", 2, 9)
        finally:
            events.append("given back")

    run = JobRunner(JobState("count", "Counting", changes_scene=changes_scene), steps(), str, str)
    assert not run.advance(0)
    return run.state


def test_another_file_ends_a_job(rig):
    state = under_way(changes_scene=False)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    assert not state.is_running and state.outcome == "Counting ended because another file was opened."
    assert events == ["given back"] and job.current() is None


@pytest.mark.parametrize("changes_scene", [True, False])
def test_an_undo_ends_only_jobs_that_change_the_scene(rig, changes_scene):
    bpy.ops.ed.undo_push()
    rig.mesh_object.location.x = 1
    bpy.ops.ed.undo_push()
    state = under_way(changes_scene)
    bpy.ops.ed.undo()
    assert state.is_running is not changes_scene
    job.stop("The test is over.")
    assert events == ["given back"]


def test_disabling_the_addon_ends_a_job():
    import fdda_addon

    state = under_way(changes_scene=False)
    fdda_addon.unregister()
    assert not state.is_running and events == ["given back"]
    fdda_addon.register()


def test_remaining_time_comes_from_the_speed_of_the_stage(monkeypatch):
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    state = JobState("record", "Recording")
    assert state.remaining_seconds is None
    state.show(Progress("poses", 500, 1000))
    assert state.remaining_seconds is None, "a resumed recording has not done these now"
    now[0] += 10
    state.show(Progress("poses", 600, 1000))
    assert state.remaining_seconds == pytest.approx(40)
    state.show(Progress("starting", 0, 0))
    now[0] += 3
    state.show(Progress("starting", 3, 0))
    assert state.remaining_seconds is None, "without a total, the progress counts seconds"


def test_a_job_with_steps_counts_them_and_knows_the_remaining_time_of_the_running_one(monkeypatch):
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    state = JobState("build_model", "Record, Train & Bind")
    state.steps = [("recording", ("poses", "influences")), ("reading it", ("starting",)), ("training", ("epochs",))]
    assert (state.heading, state.detail, state.remaining_text) == ("Step 1 of 3", "Recording…", "…")
    state.show(Progress("poses", 0, 1000))
    now[0] += 40
    state.show(Progress("poses", 500, 1000))
    assert state.sentence == "Step 1 of 3: recording: 500 of 1,000" and state.fraction == 0.5
    assert state.remaining_text == "About 40 s left in this step"
    state.show(Progress("influences", 9, 9))
    assert state.detail == "Bones and inputs moved alone: 9 of 9" and not state.is_finishing, "the training follows"
    state.show(Progress("starting", 2, 0))
    assert state.detail == "Reading it: 2 s" and state.remaining_seconds is None
    state.show(Progress("epochs", 0, 200))
    now[0] += 10
    state.show(Progress("epochs", 50, 200))
    assert state.sentence == "Step 3 of 3: training: 50 of 200" and state.remaining_text == "About 30 s left"
    state.show(Progress("epochs", 200, 200))
    assert state.is_finishing and state.remaining_text == "Finishing…"


@pytest.mark.parametrize("stage", ["poses", "epochs", "frames of 'arm'"])
def test_a_job_is_finishing_when_its_last_stage_is_complete(stage):
    state = JobState("record", "Recording")
    state.show(Progress(stage, 9, 10))
    assert not state.is_finishing
    state.show(Progress(stage, 10, 10))
    assert state.is_finishing


@pytest.mark.parametrize("stage", ["probes", "poses to fit", "key joints", "fit", "target of 'arm'"])
def test_a_job_is_not_finishing_when_a_preparing_stage_is_complete(stage):
    state = JobState("record", "Recording")
    state.show(Progress(stage, 10, 10))
    assert not state.is_finishing


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
