# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs tasks on a Dask cluster, local or existing. The workers only start processes for the verbs."""

import contextlib
import itertools
import logging
import os
import threading
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING

from fdda_addon.core.errors import TRY_AGAIN, FDDAError, exit_status

from .characters import Farm
from .process import TryAgainError
from .run import AGAIN, BLOCKED, FAILED, SUCCESS_STATES, Outcome, run_task
from .simulation import seconds_to_end, task_seconds
from .task import Task
from .tasks import TRAIN

if TYPE_CHECKING:
    from distributed import Client

TASK_MB = 3000
"""Memory to reserve per local worker, MB: one Blender with a character, or one training."""
CPU_RESOURCE, GPU_RESOURCE = "recording", "GPU"
"""Dask resources of workers where trainings need a GPU. A worker has one of them or both."""
CONNECT_SECONDS = 60
WORKER_CHECK_SECONDS, MAX_MISSED_CHECKS = 3.0, 6
"""Interval of the checks for lost workers, and how many checks a worker may miss before it is replaced."""
MAX_LOST_WORKERS = 1_000
"""How many workers a task may lose before it fails. A repeated task continues its partial work."""
DASK_SETTINGS = {
    "distributed": {
        "scheduler": {"unknown-task-duration": "30s", "work-stealing-interval": "100ms"},
        "worker": {"profile": {"enabled": False}},
        "admin": {"tick": {"interval": "1s"}, "system-monitor": {"interval": "5s"}},
    }
}
"""Settings for tasks of minutes; Dask's defaults are for tasks of milliseconds. With the defaults, a task waits up to
11 s for a busy worker although another is idle, and Dask's monitoring of two workers takes an eighth of a core."""
_unclosed_clusters: list[contextlib.ExitStack] = []
"""References to clusters that are not closed. Without a reference, Python would close them."""


class ClusterError(TryAgainError):
    """The cluster cannot be reached, or its scheduler was lost."""


def count_local_workers() -> int:
    """Return the number of workers that fit the cores and the memory of this machine."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    memory_mb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e6
    return max(1, min(cores, int(memory_mb // TASK_MB)))


@contextlib.contextmanager
def connect_cluster(farm: Farm, scheduler: str, workers: int, host: str, port: int) -> Iterator["Client"]:
    """Yield a client of a cluster.

    Args:
        farm: settings, which tell whether trainings need a GPU.
        scheduler: address of a running cluster, "tcp://…"; "dask" for the cluster of Dask's configuration; empty to
            start a local cluster, which ends with the context.
        workers: number of workers of a local cluster.
        host: address that its scheduler listens on.
        port: port of its dashboard, 0 for any free port.

    Raises:
        ClusterError: the cluster cannot be reached.
        FDDAError: distributed is not installed.
    """
    try:
        import dask
        from distributed import Client
    except ModuleNotFoundError as error:
        raise FDDAError(
            f"The farm needs the Python package '{error.name}'; make farm sets up an environment with it."
        ) from error
    dask.config.set({"distributed.scheduler.allowed-failures": MAX_LOST_WORKERS})
    dask.config.update_defaults(DASK_SETTINGS)
    with contextlib.ExitStack() as stack:
        try:
            if scheduler:
                address = {} if scheduler == "dask" else {"address": scheduler}
                client = Client(**address, timeout=CONNECT_SECONDS, set_as_default=False)
            else:
                cluster = stack.enter_context(_local_cluster(farm, workers, host, port))
                client = Client(cluster, set_as_default=False)
        except (OSError, ValueError, RuntimeError) as error:
            where = f"There is no scheduler at '{scheduler}'" if scheduler else "The local cluster did not start"
            raise ClusterError(f"{where} ({error}).") from error
        try:
            yield stack.enter_context(client)
        except KeyboardInterrupt:
            # Dask takes ten seconds to close a cluster; `stopping` ends its processes at once.
            _unclosed_clusters.append(stack.pop_all())
            raise


@contextlib.contextmanager
def _local_cluster(farm: Farm, workers: int, host: str, port: int) -> Iterator[object]:
    """Start a cluster on this machine. Dask cannot limit the verbs' processes, so workers have no memory limit."""
    from distributed import Nanny, Scheduler, SpecCluster

    log_level = logging.CRITICAL
    options = {"nthreads": 1, "memory_limit": None, "host": host, "dashboard": False, "silence_logs": log_level}
    resources = [CPU_RESOURCE] * workers + [GPU_RESOURCE] * farm.gpu
    specs = {
        index: {"cls": Nanny, "options": {**options, "resources": {resource: 1}}}
        for index, resource in enumerate(resources)
    }
    scheduler = {"cls": Scheduler, "options": {"host": host, "dashboard": True, "dashboard_address": f"{host}:{port}"}}
    with SpecCluster(workers=specs, scheduler=scheduler, silence_logs=log_level) as cluster:
        stop_event = threading.Event()
        replacer = threading.Thread(target=_replace_lost_workers, args=(cluster, stop_event), daemon=True)
        replacer.start()
        try:
            yield cluster
        finally:
            stop_event.set()
            replacer.join()


def _replace_lost_workers(cluster: object, stop_event: threading.Event) -> None:
    """Replace lost workers until an event is set. A nanny restarts its worker, but nothing restarts a killed nanny."""
    missed_checks: dict[int, int] = {}
    new_names = itertools.count(len(cluster.worker_spec))
    while not stop_event.wait(WORKER_CHECK_SECONDS):
        present = {worker["name"] for worker in dict(cluster.scheduler_info["workers"]).values()}
        missed_checks = {name: missed_checks.get(name, 0) + 1 for name in cluster.worker_spec if name not in present}
        if lost_workers := [name for name, count in missed_checks.items() if count > MAX_MISSED_CHECKS]:
            for name in lost_workers:
                cluster.worker_spec[next(new_names)] = cluster.worker_spec.pop(name)
            cluster.scale(len(cluster.worker_spec))


def run_tasks_on(
    client: "Client", farm: Farm, tasks: dict[str, Task], names: list[str], overwrite: bool = False
) -> Iterator[Outcome]:
    """Run tasks on a cluster, each after its dependencies.

    Args:
        client: client of the cluster.
        farm, tasks: the graph.
        names: names of the tasks to run, each after its dependencies.
        overwrite: see `outputs.check_published`.

    Yields:
        The outcome of each task when it ends.

    Raises:
        ClusterError: the scheduler was lost.
    """
    from distributed import as_completed

    futures, run_id = {}, f"{time.time():.3f}"
    remaining_seconds = seconds_to_end(tasks, task_seconds(tasks)[0])
    for name in names:
        task = tasks[name]
        sent_tasks = {ancestor: tasks[ancestor] for ancestor in _ancestors(tasks, name)} | {name: task}
        needs_gpu = farm.gpu and task.kind == TRAIN
        futures[name] = client.submit(
            _run_on_worker,
            farm,
            sent_tasks,
            name,
            [futures[dependency] for dependency in task.after if dependency in futures],
            overwrite,
            key=f"{name}-{run_id}",
            retries=farm.retries,
            resources={GPU_RESOURCE if needs_gpu else CPU_RESOURCE: 1} if farm.gpu else None,
            # Start the task with the longest path to the end of the graph first, as `simulation.simulate` does.
            priority=remaining_seconds[name],
            pure=False,
        )
    names_by_key = {future.key: name for name, future in futures.items()}
    try:
        for future in as_completed(futures.values(), loop=client.loop):
            yield _outcome_of_future(names_by_key[future.key], future)
            if client.status != "running":
                break
    except (OSError, TimeoutError) as error:
        raise ClusterError(f"The scheduler was lost ({error}); run the farm again to continue.") from error
    if client.status != "running":
        raise ClusterError("The scheduler was lost; run the farm again to continue.")


def _ancestors(tasks: dict[str, Task], name: str) -> list[str]:
    """Return the names of all tasks that a task depends on, directly or not."""
    ancestors: dict[str, None] = {}
    pending = list(tasks[name].after)
    while pending:
        ancestor = pending.pop()
        if ancestor not in ancestors:
            ancestors[ancestor] = None
            pending += tasks[ancestor].after
    return list(ancestors)


def _run_on_worker(
    farm: Farm, tasks: dict[str, Task], name: str, dependency_outcomes: list[Outcome], overwrite: bool
) -> Outcome:
    """Run a task in the process of a worker, unless a dependency failed."""
    from distributed import get_worker

    for outcome in dependency_outcomes:
        if outcome.state not in SUCCESS_STATES:
            return Outcome(name, BLOCKED, f"'{outcome.task}' is not done.")
    worker = get_worker()
    key = worker.get_current_task()

    def is_wanted() -> bool:
        # When the client of a farm is lost, the scheduler cancels its tasks.
        state = worker.state.tasks.get(key)
        return state is not None and state.state != "cancelled"

    outcome = run_task(farm, tasks, name, overwrite, is_wanted)
    if outcome.state == AGAIN:
        # Disk space or memory may become free in the meantime. Dask counts the attempts.
        time.sleep(farm.retry_seconds)
        raise TryAgainError(outcome.sentence)
    return outcome


def _outcome_of_future(name: str, future: object) -> Outcome:
    """Return the outcome of a task from its finished Dask future."""
    if future.status == "finished":
        return future.result()
    if future.status != "error":
        return Outcome(name, AGAIN, "The scheduler was lost.")
    error = future.exception()
    is_again = exit_status(error) == TRY_AGAIN or type(error).__name__ == "KilledWorker"
    return Outcome(name, AGAIN if is_again else FAILED, str(error) or repr(error))
