# SPDX-License-Identifier: GPL-3.0-or-later
"""Simulation of the graph's run time for a number of workers, from measured times of tasks. docs/farm.md derives it."""

import heapq
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from fdda_addon.core.recording.estimate import format_duration

from .characters import Farm
from .fingerprints import read_manifest
from .tasks import BIND, EVALUATE, INFLUENCES, KINDS, MERGE, RECORD, REFINE, TRAIN, Task

START_SECONDS = 2.0
"""What every task takes before it does anything: a process, Blender, the file, PyTorch."""
SECONDS_PER_POSE = {RECORD: 0.006, MERGE: 0.0002, TRAIN: 0.03, EVALUATE: 0.01, REFINE: 0.012}
"""Of the arm of 1,476 vertices, where nothing has been measured; docs/farm.md says how."""
SINGLE_TASK_KINDS = {INFLUENCES: 3.0, BIND: 8.0}
"""Of tasks that have no number of poses."""
GOOD_UTILIZATION = 0.5
"""More workers are worth having while this part of them works."""


@dataclass(frozen=True)
class SimulatedRun:
    """Result of a simulated run.

    Attributes:
        workers: how many.
        seconds: until the last task ends.
        busy: part of the workers' time that is work.
        path: names of the tasks of which each waited for the one before, up to the last that ended.
    """

    workers: int
    seconds: float
    busy: float
    path: tuple[str, ...]


def task_seconds(tasks: dict[str, Task]) -> tuple[dict[str, float], int]:
    """Return the seconds of each task, measured or estimated by kind, and the number of measured ones."""
    measured: dict[str, float] = {}
    rates: dict[str, list[float]] = {kind: [] for kind in KINDS}
    for name, task in tasks.items():
        manifest = read_manifest(task)
        if manifest is not None:
            measured[name] = manifest.seconds
            if not manifest.skipped:
                rates[task.kind].append((max(0.0, manifest.seconds - START_SECONDS)) / max(1, task.poses))
    return {name: measured.get(name, _estimate_seconds(task, rates[task.kind])) for name, task in tasks.items()}, len(
        measured
    )


def _estimate_seconds(task: Task, rates: list[float]) -> float:
    if rates:
        return START_SECONDS + statistics.median(rates) * max(1, task.poses)
    return START_SECONDS + SINGLE_TASK_KINDS.get(task.kind, 0.0) + SECONDS_PER_POSE.get(task.kind, 0.0) * task.poses


def seconds_to_end(tasks: dict[str, Task], seconds: dict[str, float]) -> dict[str, float]:
    """Compute for each task the longest path from its start to the end of the graph, seconds."""
    rest = dict.fromkeys(tasks, 0.0)
    for name in reversed(tasks):
        # What waits for it comes later in the graph, and has told already what follows.
        rest[name] += seconds[name]
        for other in tasks[name].after:
            if other in rest:
                rest[other] = max(rest[other], rest[name])
    return rest


def simulate(tasks: dict[str, Task], seconds: dict[str, float], workers: int) -> SimulatedRun:
    """Simulate the graph: a free worker takes the ready task with the longest path to the end.

    Args:
        tasks: the graph, each task after those that it needs.
        seconds: of each task.
        workers: how many tasks run at a time.
    """
    users: dict[str, list[str]] = {name: [] for name in tasks}
    missing = {name: [other for other in task.after if other in tasks] for name, task in tasks.items()}
    for name, before in missing.items():
        for other in before:
            users[other].append(name)
    rest = seconds_to_end(tasks, seconds)
    left = {name: len(before) for name, before in missing.items()}
    ready = [(-rest[name], name) for name, count in left.items() if not count]
    heapq.heapify(ready)
    running: list[tuple[float, str]] = []
    waited_for: dict[str, str] = {}
    now, last = 0.0, ""
    while ready or running:
        while ready and len(running) < workers:
            _, name = heapq.heappop(ready)
            heapq.heappush(running, (now + seconds[name], name))
            waited_for[name] = last
        now, last = heapq.heappop(running)
        for user in users[last]:
            left[user] -= 1
            if not left[user]:
                heapq.heappush(ready, (-rest[user], user))
    path = [last] if last else []
    while path and waited_for[path[-1]]:
        path.append(waited_for[path[-1]])
    busy = sum(seconds[name] for name in tasks) / (now * workers) if now else 1.0
    return SimulatedRun(workers, now, busy, tuple(reversed(path)))


def longest_path(tasks: dict[str, Task], seconds: dict[str, float]) -> tuple[float, list[str]]:
    """Find the longest path, a lower bound for any number of workers: its seconds and the names of its tasks."""
    until: dict[str, tuple[float, list[str]]] = {}
    for name, task in tasks.items():
        before = max(
            (until[other] for other in task.after if other in until), default=(0.0, []), key=lambda way: way[0]
        )
        until[name] = (before[0] + seconds[name], [*before[1], name])
    return max(until.values(), default=(0.0, []), key=lambda way: way[0])


def print_estimate(farm: Farm, tasks: dict[str, Task], counts: Sequence[int]) -> int:
    """Print run times for numbers of workers, and what limits them; return the exit status."""
    seconds, measured = task_seconds(tasks)
    total = sum(seconds.values())
    runs = [simulate(tasks, seconds, count) for count in sorted(set(counts))]
    print(
        f"{len(tasks)} tasks of {len({task.character for task in tasks.values()})} characters, {measured} of them "
        f"measured: {format_duration(total)} one after the other."
    )
    print(f"{'workers':>8} {'seconds':>10} {'times as fast':>14} {'workers busy':>13}")
    for run in runs:
        faster = total / max(run.seconds, 1e-9)
        print(f"{run.workers:>8,} {run.seconds:>10,.1f} {faster:>14,.1f} {100 * run.busy:>12,.0f}%")
    for line in _advice(farm, tasks, seconds, runs):
        print(line)
    return 0


def _advice(farm: Farm, tasks: dict[str, Task], seconds: dict[str, float], runs: list[SimulatedRun]) -> list[str]:
    shortest, path = longest_path(tasks, seconds)
    if not path:
        return ["There is nothing to do."]
    good = [run.workers for run in runs if run.busy >= GOOD_UTILIZATION]
    lines = [
        f"More than {max(good):,} workers stand idle for more than half of the time."
        if good and len(good) < len(runs)
        else f"Up to {max(run.workers for run in runs):,} workers are busy for more than half of the time."
        if good
        else f"Even {runs[0].workers:,} workers stand idle for more than half of the time."
    ]
    lines.append(
        f"No number of workers takes less than {format_duration(shortest).removeprefix('about ')}: tasks of "
        f"'{tasks[path[0]].character}' that wait for each other."
    )
    kinds = {kind: sum(seconds[name] for name in path if tasks[name].kind == kind) for kind in KINDS}
    kind = max(kinds, key=kinds.get)
    lines.append(f"Most of it, {100 * kinds[kind] / max(shortest, 1e-9):.0f} %, is {kind}: {_remedy(farm, kind)}.")
    return lines


def _remedy(farm: Farm, kind: str) -> str:
    return {
        RECORD: "raise shards, up to where a shard takes as long as Blender takes to start",
        REFINE: "fewer refine_poses or rounds, or more poses to begin with, which shards divide",
        TRAIN: "a training is one task; "
        + ("give it fewer epochs or a faster GPU" if farm.gpu else "a GPU (gpu = true), more threads, or fewer epochs"),
        MERGE: "fewer poses, or a faster shared folder",
        EVALUATE: "fewer evaluate_poses",
        INFLUENCES: "they are found once for all shards; a rig with fewer control bones to sample has fewer to find",
        BIND: "pictures = false",
    }[kind]
