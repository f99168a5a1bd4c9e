# SPDX-License-Identifier: GPL-3.0-or-later
"""How long a graph takes on so many workers: graphs whose answer is known, and what is printed of a plan."""

from pathlib import Path

import pytest

from farm.characters import Farm
from farm.fingerprints import TaskManifest, write_manifest
from farm.simulation import (
    SINGLE_TASK_KINDS,
    START_SECONDS,
    longest_path,
    print_estimate,
    seconds_to_end,
    simulate,
    task_seconds,
)
from farm.tasks import RECORD, Task, make_tasks

from .conftest import ONE


def graph(**after: str) -> dict[str, Task]:
    return {
        name: Task(name, RECORD, "one", Path(name), (("record",),), (), tuple(before.split()))
        for name, before in after.items()
    }


def test_independent_tasks_divide():
    tasks = graph(a="", b="", c="", d="")
    seconds = dict.fromkeys(tasks, 3.0)
    assert [simulate(tasks, seconds, count).seconds for count in (1, 2, 3, 4, 9)] == [12, 6, 6, 3, 3]
    assert simulate(tasks, seconds, 3).busy == pytest.approx(12 / 18)


def test_tasks_that_wait_for_each_other_do_not():
    tasks = graph(a="", b="a", c="b")
    seconds = {"a": 1.0, "b": 2.0, "c": 3.0}
    for count in (1, 5):
        run = simulate(tasks, seconds, count)
        assert (run.seconds, run.path) == (6, ("a", "b", "c"))
    assert longest_path(tasks, seconds) == (6, ["a", "b", "c"])


def test_what_has_the_longest_way_goes_first():
    """Shards and their merge; a short task that nothing waits for comes last, and hides beside the others."""
    tasks = graph(short="", a="", b="", merge="a b", train="merge")
    seconds = {"short": 2.0, "a": 2.0, "b": 2.0, "merge": 1.0, "train": 5.0}
    assert seconds_to_end(tasks, seconds) == {"short": 2, "a": 8, "b": 8, "merge": 6, "train": 5}
    assert simulate(tasks, seconds, 2).seconds == 8
    assert simulate(tasks, seconds, 1).seconds == sum(seconds.values())


def test_no_number_of_workers_beats_the_longest_path_nor_the_sum(written):
    tasks = make_tasks(written(ONE + "shards = 7\ngoal_mm = 1\nrounds = 3\n"))
    seconds, measured = task_seconds(tasks)
    assert measured == 0 and min(seconds.values()) >= START_SECONDS
    total, (longest, _) = sum(seconds.values()), longest_path(tasks, seconds)
    before = total + 1
    for count in (1, 2, 3, 8, 512):
        run = simulate(tasks, seconds, count)
        assert max(longest, total / count) - 1e-9 <= run.seconds <= before
        before = run.seconds
    assert before == pytest.approx(longest)


def test_what_was_measured_is_taken_and_carried_over(written):
    plan = written(ONE + '[characters.other]\nrig = "elbow.blend"\noutput = "o"\nposes = 60\n')
    tasks = make_tasks(plan)
    manifest = TaskManifest("key", {}, seconds=START_SECONDS + 5.0)
    (plan.farm.work / "elbow").mkdir(parents=True)
    write_manifest(tasks["elbow/record-1"], manifest)
    seconds, measured = task_seconds(tasks)
    assert measured == 1 and seconds["elbow/record-1"] == manifest.seconds
    # 10 poses took 5 seconds, and 30 take 15.
    assert seconds["other/record-1"] == pytest.approx(START_SECONDS + 15)
    assert seconds["other/influences"] == START_SECONDS + SINGLE_TASK_KINDS["influences"]


def test_the_estimate_says_what_bounds_it(written, capsys):
    tasks = make_tasks(written(ONE + "poses = 100000\nshards = 1\ntrain = { epochs = 1 }"))
    assert print_estimate(Farm(Path("work")), tasks, [8, 1]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("6 tasks of 1 characters, 0 of them measured: about ")
    assert [line.split()[0] for line in lines[2:4]] == ["1", "8"]
    assert "More than 1 workers stand idle for more than half of the time." in lines
    assert lines[-1].startswith("Most of it, ") and "train: a training is one task; a GPU (gpu = true)" in lines[-1]
