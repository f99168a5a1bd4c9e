# SPDX-License-Identifier: GPL-3.0-or-later
"""Running of one task: checks its inputs, runs its verbs, and writes its manifest.

A task may be killed at any moment and started again on any machine. Partial work is continued, finished work is not
repeated, and only one process runs a task at a time.
"""

import contextlib
import os
import shutil
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from fdda_addon.core.errors import FDDAError, exit_status
from fdda_addon.core.output import atomic_write, is_temporary_name, write_text

from .characters import Farm
from .fingerprints import (
    InputFingerprints,
    ManifestError,
    TaskManifest,
    check_outputs,
    digest_outputs,
    finite_float,
    is_up_to_date,
    read_json,
    read_manifest,
    write_manifest,
)
from .outputs import check_published, check_task_folder_free
from .process import ProcessResult, TryAgainError, hold_lock, run_verb
from .tasks import BIND, EVALUATION, REPORT, Task

DONE, UP_TO_DATE, NOT_NEEDED, FAILED, AGAIN, BLOCKED = (
    *("done", "up to date", "not needed", "failed", "try again", "blocked"),
)
SUCCESS_STATES = (DONE, UP_TO_DATE, NOT_NEEDED)
FINGERPRINT_FILE = ".fdda-farm-key"
"""In the folder of a task: what the files in it are made for."""
EXHAUSTED = "exhausted"
WRONG_KIND_ERRORS = (IsADirectoryError, NotADirectoryError, FileExistsError, PermissionError)


@dataclass(frozen=True)
class Outcome:
    """Outcome of a task.

    Attributes:
        task: its name.
        state: `DONE`, `UP_TO_DATE`, `NOT_NEEDED`, `FAILED`, `AGAIN` (for a reason of the machine's) or `BLOCKED`.
        sentence: why it failed, or was not needed.
        seconds, peak_mb: of its verbs.
        host: name of the machine.
    """

    task: str
    state: str
    sentence: str = ""
    seconds: float = 0.0
    peak_mb: float = 0.0
    host: str = ""


def run_task(
    farm: Farm, tasks: dict[str, Task], name: str, overwrite: bool = False, is_wanted: Callable[[], bool] = lambda: True
) -> Outcome:
    """Run a task of a graph, unless it is up to date.

    Args:
        farm, tasks: the graph.
        name: of the task.
        overwrite: as of `outputs.check_published`.
        is_wanted: as of `process.run_verb`.

    Returns:
        How it ended; errors of the add-on are outcomes, any other is a bug and propagates.
    """
    task, host = tasks[name], socket.gethostname()
    try:
        key = InputFingerprints(farm, tasks).of_task(name)
        with hold_lock(task.lock) as lock:
            if is_up_to_date(task, key):
                skipped = read_manifest(task).skipped
                return Outcome(name, NOT_NEEDED if skipped else UP_TO_DATE, skipped, host=host)
            if skipped := _reason_to_skip(tasks, task):
                write_manifest(task, TaskManifest(key, {}, skipped, host=host))
                return Outcome(name, NOT_NEEDED, skipped, host=host)
            check_published(task, overwrite)
            manifest = _run_verbs(
                tasks, task, key, lambda verb: run_verb(farm, verb, task.folder, task.log, lock, is_wanted)
            )
            write_manifest(task, manifest)
        return Outcome(name, DONE, "", manifest.seconds, manifest.peak_mb, host)
    except FDDAError as error:
        state = AGAIN if exit_status(error) == TryAgainError.exit_status else FAILED
        return Outcome(name, state, str(error), host=host)
    except OSError as error:
        # Of the shared folder, unless something else is in its place.
        state = FAILED if isinstance(error, WRONG_KIND_ERRORS) else AGAIN
        return Outcome(name, state, f"'{error.filename}': {error.strerror or error}.", host=host)


def _reason_to_skip(tasks: dict[str, Task], task: Task) -> str:
    """Return why a task of a later round is not needed; empty where it is needed."""
    if task.round is None:
        return ""
    previous = read_manifest(tasks[task.round.evaluate])
    if previous is not None and previous.skipped:
        return previous.skipped
    train = tasks[task.round.train]
    check_outputs(train, lambda name: name in REPORT)
    check_outputs(tasks[task.round.evaluate])
    p999_mm = read_p999_mm(tasks[task.round.evaluate])
    if p999_mm <= task.round.goal_mm:
        return f"99.9 % of the vertices are within {p999_mm:.3g} mm, and the goal is {task.round.goal_mm:g} mm."
    if _verdict(train) == EXHAUSTED:
        return f"More poses no longer help: 99.9 % of the vertices are within {p999_mm:.3g} mm."
    return ""


def read_p999_mm(evaluate: Task) -> float:
    """Read the 99.9th percentile of the error from the evaluation of a task, mm.

    Raises:
        ManifestError: it does not say.
    """
    try:
        return finite_float(read_json(evaluate.folder / EVALUATION)["fdda"]["p999"])
    except (OSError, LookupError, TypeError, ValueError, ArithmeticError) as error:
        raise _damaged_error(evaluate, EVALUATION, error) from error


def _verdict(train: Task) -> object:
    """Read the verdict from the report of a training; None without an accuracy goal."""
    try:
        return read_json(train.folder / REPORT[0]).get("goal", {}).get("verdict")
    except (OSError, AttributeError, ValueError) as error:
        raise _damaged_error(train, REPORT[0], error) from error


def _damaged_error(task: Task, name: str, error: Exception) -> ManifestError:
    """Return the error of a damaged output, and mark its task as not done."""
    task.manifest.unlink(missing_ok=True)
    return ManifestError(f"'{task.folder / name}' is damaged ({error}); run the farm again, and it is made again.")


def _run_verbs(
    tasks: dict[str, Task], task: Task, key: str, run: Callable[[tuple[str, ...]], ProcessResult]
) -> TaskManifest:
    notes = {}
    _check_inputs(tasks, task)
    _prepare(task, key)
    if task.kind == BIND:
        notes["bound"] = _copy_best_models(tasks, task)
    for source, name in task.copies:
        _copy(source, task.folder / name)
    started, peak = time.monotonic(), 0.0
    for verb in task.verbs:
        peak = max(peak, run(verb).peak_mb)
    seconds = time.monotonic() - started
    outputs = digest_outputs(task)
    for name, destination in task.publishes:
        _copy(task.folder / name, destination)
    return TaskManifest(key, outputs, "", round(seconds, 3), round(peak, 1), socket.gethostname(), notes)


def _check_inputs(tasks: dict[str, Task], task: Task) -> None:
    """Check the outputs of earlier tasks that this task uses."""
    used = [argument for verb in task.verbs for argument in verb] + [str(source) for source, _ in task.copies]
    for name in task.after:
        previous = tasks[name]
        manifest = read_manifest(previous)
        if manifest is not None and manifest.skipped:
            continue
        used_paths = tuple(path for path in used if Path(path).is_relative_to(previous.folder))
        # Of a recording of several meshes, one may be used; of a model, what lies beside it is of use to others.
        names = tuple(Path(path).relative_to(previous.folder).as_posix() for path in used_paths)
        is_chosen = task.kind == BIND
        check_outputs(previous, lambda file, names=names, all_=is_chosen: all_ or _is_inside(file, names))


def _is_inside(file: str, names: tuple[str, ...]) -> bool:
    return any(file == name or file.startswith(f"{name}/") for name in names)


def _prepare(task: Task, key: str) -> None:
    """Prepare the folder of a task: remove files of other inputs, keep partial work of the same inputs."""
    fingerprint_file = task.folder / FINGERPRINT_FILE
    if not fingerprint_file.is_file():
        check_task_folder_free(task)
    task.manifest.unlink(missing_ok=True)
    # Nobody else holds the task: what is half is of processes that were killed, on whatever machine.
    for partial in (
        *task.folder.parent.glob(f".new-{task.folder.name}-*"),
        *task.folder.parent.glob(f".old-{task.folder.name}-*"),
    ):
        shutil.rmtree(partial, ignore_errors=True)
    if task.folder.exists() and fingerprint_file.read_bytes() != key.encode():
        old = task.folder.with_name(f".old-{task.folder.name}-{os.getpid()}")
        os.replace(task.folder, old)
        shutil.rmtree(old, ignore_errors=True)
    for path in task.folder.rglob("*") if task.folder.exists() else ():
        if is_temporary_name(path.name) or path.name == "recording.lock":
            path.unlink(missing_ok=True)
    if not task.folder.exists():
        new = task.folder.with_name(f".new-{task.folder.name}-{os.getpid()}")
        new.mkdir(parents=True)
        # What was printed while it was something else.
        task.log.unlink(missing_ok=True)
        write_text(new / FINGERPRINT_FILE, key)
        os.replace(new, task.folder)


def _copy_best_models(tasks: dict[str, Task], task: Task) -> dict[str, str]:
    """Copy the best model of all rounds with its reports, for each bound model."""
    bound = {}
    for destination, rounds in task.choices:
        evaluated_rounds = [(train, evaluate) for train, evaluate in rounds if not read_manifest(tasks[train]).skipped]
        train, evaluate = min(evaluated_rounds, key=lambda pair: read_p999_mm(tasks[pair[1]]))
        model_path = task.folder / destination
        model_path.parent.mkdir(parents=True, exist_ok=True)
        _copy(tasks[train].folder / model_path.name, model_path)
        for name in REPORT:
            _copy(tasks[train].folder / name, model_path.with_name(name))
        _copy(tasks[evaluate].folder / EVALUATION, model_path.with_name(EVALUATION))
        bound[destination] = train
    return bound


def _copy(source: Path, target: Path) -> None:
    """Copy a file, or a folder that does not exist yet, because an existing folder may be partial work.

    Raises:
        OutputError: the disk is full.
        OSError: the same, of a folder.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    if not source.is_dir():
        with atomic_write(target) as temporary:
            shutil.copyfile(source, temporary)
        return
    if target.exists():
        return
    new = target.with_name(f".new-{target.name}-{os.getpid()}")
    with contextlib.suppress(FileNotFoundError):
        shutil.rmtree(new)
    try:
        shutil.copytree(source, new, ignore=shutil.ignore_patterns("*.lock"))
        os.replace(new, target)
    finally:
        shutil.rmtree(new, ignore_errors=True)
