# SPDX-License-Identifier: GPL-3.0-or-later
"""Tests of the estimated run time: graphs with known run times, and the printed estimate of a plan."""

from pathlib import Path

import pytest

from farm.characters import Farm
from farm.fingerprints import TaskManifest, write_manifest
from farm.simulation import (
    SECONDS_PER_TASK,
    START_SECONDS,
    longest_path,
    print_estimate,
    seconds_to_end,
    simulate,
    task_seconds,
)
from farm.task import Task
from farm.tasks import RECORD, make_tasks

from .conftest import ONE_CHARACTER


def make_graph(**after: str) -> dict[str, Task]:
    """Make tasks by name, each with the names of its dependencies."""
    return {
        name: Task(name, RECORD, "one", Path(name), (("record",),), (), tuple(dependencies.split()))
        for name, dependencies in after.items()
    }


def test_independent_tasks_are_divided_among_workers():
    tasks = make_graph(a="", b="", c="", d="")
    seconds = dict.fromkeys(tasks, 3.0)
    assert [simulate(tasks, seconds, count).seconds for count in (1, 2, 3, 4, 9)] == [12, 6, 6, 3, 3]
    assert simulate(tasks, seconds, 3).utilization == pytest.approx(12 / 18)


def test_a_chain_of_tasks_takes_its_sum_on_any_number_of_workers():
    tasks = make_graph(a="", b="a", c="b")
    seconds = {"a": 1.0, "b": 2.0, "c": 3.0}
    for count in (1, 5):
        run = simulate(tasks, seconds, count)
        assert (run.seconds, run.path) == (6, ("a", "b", "c"))
    assert longest_path(tasks, seconds) == (6, ["a", "b", "c"])


def test_the_task_with_the_longest_path_to_the_end_runs_first():
    """Two shards run before a short task that no other task waits for."""
    tasks = make_graph(short="", a="", b="", merge="a b", train="merge")
    seconds = {"short": 2.0, "a": 2.0, "b": 2.0, "merge": 1.0, "train": 5.0}
    assert seconds_to_end(tasks, seconds) == {"short": 2, "a": 8, "b": 8, "merge": 6, "train": 5}
    assert simulate(tasks, seconds, 2).seconds == 8
    assert simulate(tasks, seconds, 1).seconds == sum(seconds.values())


def test_the_run_time_is_at_least_the_longest_path_and_the_mean_load(write_plan):
    tasks = make_tasks(write_plan(ONE_CHARACTER + "shards = 7\ngoal_mm = 1\nrounds = 3\n"))
    seconds, measured_count = task_seconds(tasks)
    assert measured_count == 0 and min(seconds.values()) >= START_SECONDS
    total, (longest, _) = sum(seconds.values()), longest_path(tasks, seconds)
    last_run_seconds = total + 1
    for count in (1, 2, 3, 8, 512):
        run = simulate(tasks, seconds, count)
        assert max(longest, total / count) - 1e-9 <= run.seconds <= last_run_seconds
        last_run_seconds = run.seconds
    assert last_run_seconds == pytest.approx(longest)


def test_measured_times_are_used_and_scaled_to_other_characters(write_plan):
    plan = write_plan(ONE_CHARACTER + '[characters.other]\nrig = "elbow.blend"\noutput = "o"\nposes = 60\n')
    tasks = make_tasks(plan)
    manifest = TaskManifest("key", {}, seconds=START_SECONDS + 5.0)
    (plan.farm.work / "elbow").mkdir(parents=True)
    write_manifest(tasks["elbow/record-1"], manifest)
    seconds, measured_count = task_seconds(tasks)
    assert measured_count == 1 and seconds["elbow/record-1"] == manifest.seconds
    # 10 poses took 5 seconds, so 30 poses take 15.
    assert seconds["other/record-1"] == pytest.approx(START_SECONDS + 15)
    assert seconds["other/influences"] == START_SECONDS + SECONDS_PER_TASK["influences"]


def test_the_printed_estimate_names_its_limit_and_a_remedy(write_plan, capsys):
    tasks = make_tasks(write_plan(ONE_CHARACTER + "poses = 100000\nshards = 1\ntrain = { epochs = 1 }"))
    assert print_estimate(Farm(Path("work")), tasks, [8, 1]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("6 tasks of 1 character, 0 of them measured: about ")
    assert [line.split()[0] for line in lines[2:4]] == ["1", "8"]
    assert "More than 1 workers are idle for more than half of the time." in lines
    assert lines[-1].startswith("Most of it, ") and "train: a training is one task; a GPU (gpu = true)" in lines[-1]
