# SPDX-License-Identifier: GPL-3.0-or-later
"""Running of tasks on a Dask cluster, local or existing. Workers start processes and compute nothing themselves."""

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
from .tasks import TRAIN, Task

if TYPE_CHECKING:
    from distributed import Client

LOOPBACK = "127.0.0.1"
TASK_MB = 3000
"""What a local worker is counted with: a Blender with a character, or a training."""
CPU, GPU = "recording", "GPU"
"""Resources of workers, where trainings need a GPU: a worker has one of them, or both."""
CONNECT_SECONDS = 60
KEEP_SECONDS, ABSENCES = 3.0, 6
"""How often workers are counted, and how often one may be missed before there is another in its place."""
LOST_WORKERS = 1_000
"""A task may lose so many workers: it goes on where it was, whatever ended them."""
SETTINGS = {
    "distributed": {
        "scheduler": {"unknown-task-duration": "30s", "work-stealing-interval": "100ms"},
        "worker": {"profile": {"enabled": False}},
        "admin": {"tick": {"interval": "1s"}, "system-monitor": {"interval": "5s"}},
    }
}
"""Dask's own are for tasks of milliseconds. With them a task waits up to 11 s for a worker that is at another one,
beside one that has nothing to do, and what Dask does to watch itself takes an eighth of a core on two workers."""
_left_open: list[contextlib.ExitStack] = []
"""Kept until the program ends: what would be closed when it is collected."""


class ClusterError(TryAgainError):
    """The cluster cannot be reached, or was lost."""


def local_workers() -> int:
    """Return the number of workers for the cores and the memory of this machine."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e6
    return max(1, min(cores, int(memory // TASK_MB)))


@contextlib.contextmanager
def connect_cluster(farm: Farm, scheduler: str, workers: int, host: str, port: int) -> Iterator["Client"]:
    """Yield a client of a cluster.

    Args:
        farm: whether trainings need a GPU.
        scheduler: address of a cluster that is there, "tcp://…"; "dask" for what Dask's own configuration names; empty
            to start one here, which ends with the block.
        workers: of a local cluster.
        host: what its scheduler listens on.
        port: of its dashboard, 0 for any.

    Raises:
        ClusterError: it cannot be reached.
        FDDAError: distributed is not installed.
    """
    try:
        import dask
        from distributed import Client
    except ModuleNotFoundError as error:
        raise FDDAError(
            f"The farm needs the Python package '{error.name}'; make farm sets an environment up that has it."
        ) from error
    dask.config.set({"distributed.scheduler.allowed-failures": LOST_WORKERS})
    dask.config.update_defaults(SETTINGS)
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
            # Dask takes ten seconds to close what `stopping` ends at once.
            _left_open.append(stack.pop_all())
            raise


@contextlib.contextmanager
def _local_cluster(farm: Farm, workers: int, host: str, port: int) -> Iterator[object]:
    """Make a cluster of processes on this machine. Dask does not limit child processes, so workers are sized here."""
    from distributed import Nanny, Scheduler, SpecCluster

    quiet = logging.CRITICAL
    options = {"nthreads": 1, "memory_limit": None, "host": host, "dashboard": False, "silence_logs": quiet}
    kinds = [CPU] * workers + [GPU] * farm.gpu
    specs = {n: {"cls": Nanny, "options": {**options, "resources": {kind: 1}}} for n, kind in enumerate(kinds)}
    scheduler = {"cls": Scheduler, "options": {"host": host, "dashboard": True, "dashboard_address": f"{host}:{port}"}}
    with SpecCluster(workers=specs, scheduler=scheduler, silence_logs=quiet) as cluster:
        stop = threading.Event()
        keeper = threading.Thread(target=_keep_workers, args=(cluster, stop), daemon=True)
        keeper.start()
        try:
            yield cluster
        finally:
            stop.set()
            keeper.join()


def _keep_workers(cluster: object, stop: threading.Event) -> None:
    """Replace lost workers: a nanny restarts its worker, but gives up when that is killed, too."""
    absent: dict[int, int] = {}
    following = itertools.count(len(cluster.worker_spec))
    while not stop.wait(KEEP_SECONDS):
        there = {worker["name"] for worker in dict(cluster.scheduler_info["workers"]).values()}
        absent = {name: absent.get(name, 0) + 1 for name in cluster.worker_spec if name not in there}
        if lost := [name for name, times in absent.items() if times > ABSENCES]:
            for name in lost:
                cluster.worker_spec[next(following)] = cluster.worker_spec.pop(name)
            cluster.scale(len(cluster.worker_spec))


def run_on(
    client: "Client", farm: Farm, tasks: dict[str, Task], names: list[str], overwrite: bool = False
) -> Iterator[Outcome]:
    """Run tasks on a cluster, each after its dependencies.

    Args:
        client: of the cluster.
        farm, tasks: the graph.
        names: of the tasks to run, each after those that it needs.
        overwrite: as of `run_task`.

    Yields:
        The outcome of each task as it ends.

    Raises:
        ClusterError: the scheduler is gone.
    """
    from distributed import as_completed

    futures, run_id = {}, f"{time.time():.3f}"
    rest = seconds_to_end(tasks, task_seconds(tasks)[0])
    for name in names:
        task = tasks[name]
        own = {other: tasks[other] for other in _ancestors(tasks, name)} | {name: task}
        needs_gpu = farm.gpu and task.kind == TRAIN
        futures[name] = client.submit(
            _run,
            farm,
            own,
            name,
            [futures[other] for other in task.after if other in futures],
            overwrite,
            key=f"{name}-{run_id}",
            retries=farm.retries,
            resources={GPU if needs_gpu else CPU: 1} if farm.gpu else None,
            # As the simulation has it: what is farthest from the end goes first.
            priority=rest[name],
            pure=False,
        )
    by_key = {future.key: name for name, future in futures.items()}
    try:
        for future in as_completed(futures.values(), loop=client.loop):
            yield _outcome(by_key[future.key], future)
            if client.status != "running":
                break
    except (OSError, TimeoutError) as error:
        raise ClusterError(f"The scheduler is gone ({error}); run the farm again, and it goes on.") from error
    if client.status != "running":
        raise ClusterError("The scheduler is gone; run the farm again, and it goes on.")


def _ancestors(tasks: dict[str, Task], name: str) -> list[str]:
    found: dict[str, None] = {}
    waiting = list(tasks[name].after)
    while waiting:
        other = waiting.pop()
        if other not in found:
            found[other] = None
            waiting += tasks[other].after
    return list(found)


def _run(farm: Farm, tasks: dict[str, Task], name: str, before: list[Outcome], overwrite: bool) -> Outcome:
    """Run a task on a worker."""
    from distributed import get_worker

    for outcome in before:
        if outcome.state not in SUCCESS_STATES:
            return Outcome(name, BLOCKED, f"'{outcome.task}' is not done.")
    worker = get_worker()
    key = worker.get_current_task()

    def is_wanted() -> bool:
        # Of a farm that is gone, the scheduler takes the tasks back.
        own = worker.state.tasks.get(key)
        return own is not None and own.state != "cancelled"

    outcome = run_task(farm, tasks, name, overwrite, is_wanted)
    if outcome.state == AGAIN:
        # Dask counts the attempts; the disk or the memory may come back meanwhile.
        time.sleep(farm.retry_seconds)
        raise TryAgainError(outcome.sentence)
    return outcome


def _outcome(name: str, future: object) -> Outcome:
    if future.status == "finished":
        return future.result()
    if future.status != "error":
        return Outcome(name, AGAIN, "The scheduler is gone.")
    error = future.exception()
    is_again = exit_status(error) == TRY_AGAIN or type(error).__name__ == "KilledWorker"
    return Outcome(name, AGAIN if is_again else FAILED, str(error) or repr(error))
