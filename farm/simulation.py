# SPDX-License-Identifier: GPL-3.0-or-later
"""Estimates the run time of the graph for a number of workers from measured times of tasks (docs/farm.md)."""

import heapq
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from fdda_addon.core.counts import format_count
from fdda_addon.core.recording.estimate import format_duration

from .characters import Farm
from .fingerprints import read_manifest
from .task import Task
from .tasks import BIND, EVALUATE, INFLUENCES, KINDS, MERGE, RECORD, REFINE, TRAIN

START_SECONDS = 2.0
"""Time that each task needs to start a process and load Blender and the file, or PyTorch."""
SECONDS_PER_POSE = {RECORD: 0.006, MERGE: 0.0002, TRAIN: 0.03, EVALUATE: 0.01, REFINE: 0.012}
"""Seconds per pose by kind of task until times are measured; from the arm with 1,476 vertices (docs/farm.md)."""
SECONDS_PER_TASK = {INFLUENCES: 3.0, BIND: 8.0}
"""Seconds of the kinds of tasks whose duration does not depend on a number of poses."""
MIN_UTILIZATION = 0.5
"""Fraction of the workers' time that has to be work for this number of workers to be recommended."""


@dataclass(frozen=True)
class SimulatedRun:
    """Result of a simulated run.

    Attributes:
        workers: number of workers.
        seconds: time until the last task ends.
        utilization: fraction of the workers' time that is work.
        path: names of tasks that each waited for the task before; the last one ended last.
    """

    workers: int
    seconds: float
    utilization: float
    path: tuple[str, ...]


def task_seconds(tasks: dict[str, Task]) -> tuple[dict[str, float], int]:
    """Return the duration of each task, measured or estimated by kind, seconds; and the number of measured tasks."""
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
    return START_SECONDS + SECONDS_PER_TASK.get(task.kind, 0.0) + SECONDS_PER_POSE.get(task.kind, 0.0) * task.poses


def seconds_to_end(tasks: dict[str, Task], seconds: dict[str, float]) -> dict[str, float]:
    """Compute for each task the longest path from its start to the end of the graph, seconds."""
    remaining_seconds = dict.fromkeys(tasks, 0.0)
    for name in reversed(tasks):
        # The tasks that depend on this one come later in the graph, so their longest path is already included.
        remaining_seconds[name] += seconds[name]
        for dependency in tasks[name].after:
            if dependency in remaining_seconds:
                remaining_seconds[dependency] = max(remaining_seconds[dependency], remaining_seconds[name])
    return remaining_seconds


def simulate(tasks: dict[str, Task], seconds: dict[str, float], workers: int) -> SimulatedRun:
    """Simulate the graph: a free worker takes the ready task with the longest path to the end.

    Args:
        tasks: the graph, each task after its dependencies.
        seconds: duration of each task.
        workers: number of tasks that run at the same time.
    """
    dependents: dict[str, list[str]] = {name: [] for name in tasks}
    dependencies = {name: [other for other in task.after if other in tasks] for name, task in tasks.items()}
    for name, names in dependencies.items():
        for dependency in names:
            dependents[dependency].append(name)
    remaining_seconds = seconds_to_end(tasks, seconds)
    missing_counts = {name: len(names) for name, names in dependencies.items()}
    ready = [(-remaining_seconds[name], name) for name, count in missing_counts.items() if not count]
    heapq.heapify(ready)
    running: list[tuple[float, str]] = []
    waited_for: dict[str, str] = {}
    now, last_ended = 0.0, ""
    while ready or running:
        while ready and len(running) < workers:
            _, name = heapq.heappop(ready)
            heapq.heappush(running, (now + seconds[name], name))
            waited_for[name] = last_ended
        now, last_ended = heapq.heappop(running)
        for dependent in dependents[last_ended]:
            missing_counts[dependent] -= 1
            if not missing_counts[dependent]:
                heapq.heappush(ready, (-remaining_seconds[dependent], dependent))
    path = [last_ended] if last_ended else []
    while path and waited_for[path[-1]]:
        path.append(waited_for[path[-1]])
    utilization = sum(seconds[name] for name in tasks) / (now * workers) if now else 1.0
    return SimulatedRun(workers, now, utilization, tuple(reversed(path)))


def longest_path(tasks: dict[str, Task], seconds: dict[str, float]) -> tuple[float, list[str]]:
    """Return the duration of the longest path, seconds, and the names of its tasks.

    It is a lower bound of the run time for any number of workers.
    """
    paths_to: dict[str, tuple[float, list[str]]] = {}
    for name, task in tasks.items():
        longest = max(
            (paths_to[dependency] for dependency in task.after if dependency in paths_to),
            default=(0.0, []),
            key=lambda path: path[0],
        )
        paths_to[name] = (longest[0] + seconds[name], [*longest[1], name])
    return max(paths_to.values(), default=(0.0, []), key=lambda path: path[0])


def print_estimate(farm: Farm, tasks: dict[str, Task], counts: Sequence[int]) -> int:
    """Print the run time for each number of workers, and what limits it; return the exit status."""
    seconds, measured_count = task_seconds(tasks)
    total_seconds = sum(seconds.values())
    runs = [simulate(tasks, seconds, count) for count in sorted(set(counts))]
    character_count = len({task.character for task in tasks.values()})
    print(
        f"{format_count(len(tasks), 'task')} of {format_count(character_count, 'character')}, "
        f"{measured_count} of them measured: {format_duration(total_seconds)} on one worker."
    )
    print(f"{'workers':>8} {'seconds':>10} {'speed-up':>14} {'utilization':>13}")
    for run in runs:
        speed_up = total_seconds / max(run.seconds, 1e-9)
        print(f"{run.workers:>8,} {run.seconds:>10,.1f} {speed_up:>14,.1f} {100 * run.utilization:>12,.0f}%")
    for line in _limits_and_remedy(farm, tasks, seconds, runs):
        print(line)
    return 0


def _limits_and_remedy(
    farm: Farm, tasks: dict[str, Task], seconds: dict[str, float], runs: list[SimulatedRun]
) -> list[str]:
    """Return lines that tell how many workers are useful, what limits the run time, and how to shorten it."""
    min_seconds, path = longest_path(tasks, seconds)
    if not path:
        return ["There is nothing to do."]
    useful_counts = [run.workers for run in runs if run.utilization >= MIN_UTILIZATION]
    lines = [
        f"More than {max(useful_counts):,} workers are idle for more than half of the time."
        if useful_counts and len(useful_counts) < len(runs)
        else f"Up to {max(run.workers for run in runs):,} workers are busy for more than half of the time."
        if useful_counts
        else f"Even {runs[0].workers:,} workers are idle for more than half of the time."
    ]
    lines.append(
        f"No number of workers takes less than {format_duration(min_seconds).removeprefix('about ')}: tasks of "
        f"'{tasks[path[0]].character}' wait for each other."
    )
    kinds = {kind: sum(seconds[name] for name in path if tasks[name].kind == kind) for kind in KINDS}
    kind = max(kinds, key=kinds.get)
    lines.append(f"Most of it, {100 * kinds[kind] / max(min_seconds, 1e-9):.0f} %, is {kind}: {_remedy(farm, kind)}.")
    return lines


def _remedy(farm: Farm, kind: str) -> str:
    return {
        RECORD: "raise shards until a shard takes as long as the start of Blender",
        REFINE: "fewer refine_poses or rounds, or more poses, which shards divide",
        TRAIN: "a training is one task; "
        + ("give it fewer epochs or a faster GPU" if farm.gpu else "a GPU (gpu = true), more threads, or fewer epochs"),
        MERGE: "fewer poses, or a faster shared folder",
        EVALUATE: "fewer evaluate_poses",
        INFLUENCES: "this is done once for all shards; it takes less time with fewer control bones to sample",
        BIND: "pictures = false",
    }[kind]
