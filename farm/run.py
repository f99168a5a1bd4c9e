# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs one task: checks its inputs, runs its verbs, and writes its manifest.

A task may be killed at any moment and started again on any machine. It then continues partial work and does not repeat
finished work. Only one process runs a task at a time.
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
from fdda_addon.core.report import Verdict

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
from .task import REPORT, Task
from .tasks import BIND, EVALUATION

DONE, UP_TO_DATE, NOT_NEEDED, FAILED, AGAIN, BLOCKED = (
    *("done", "up to date", "not needed", "failed", "try again", "blocked"),
)
SUCCESS_STATES = (DONE, UP_TO_DATE, NOT_NEEDED)
FINGERPRINT_FILE = ".fdda-farm-key"
"""File in the folder of a task that holds the fingerprint of the inputs that its files are made from."""
WRONG_KIND_ERRORS = (IsADirectoryError, NotADirectoryError, FileExistsError, PermissionError)


@dataclass(frozen=True)
class Outcome:
    """Outcome of a task.

    Attributes:
        task: name of the task.
        state: `DONE`, `UP_TO_DATE`, `NOT_NEEDED`, `FAILED`, `AGAIN` (failed because of its machine) or `BLOCKED`.
        sentence: reason why the task failed or was not needed.
        seconds, peak_mb: wall-clock time of its verbs, and peak memory of their largest process.
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
        name: name of the task.
        overwrite: see `outputs.check_published`.
        is_wanted: see `process.run_verb`.

    Returns:
        The outcome. Errors of the add-on become outcomes; any other exception is a bug and propagates.
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
        # The shared folder may work again later, unless a file or folder has the wrong kind.
        state = FAILED if isinstance(error, WRONG_KIND_ERRORS) else AGAIN
        return Outcome(name, state, f"'{error.filename}': {error.strerror or error}.", host=host)


def _reason_to_skip(tasks: dict[str, Task], task: Task) -> str:
    """Return the reason why a task of a later round is not needed; empty where it is needed."""
    if task.round is None:
        return ""
    evaluation = read_manifest(tasks[task.round.evaluate])
    if evaluation is not None and evaluation.skipped:
        return evaluation.skipped
    train = tasks[task.round.train]
    check_outputs(train, lambda name: name in REPORT)
    check_outputs(tasks[task.round.evaluate])
    p999_mm = read_p999_mm(tasks[task.round.evaluate])
    if p999_mm <= task.round.goal_mm:
        return f"99.9 % of the vertices are within {p999_mm:.3g} mm, and the goal is {task.round.goal_mm:g} mm."
    if _read_verdict(train) == Verdict.EXHAUSTED.value:
        return f"More poses no longer help: 99.9 % of the vertices are within {p999_mm:.3g} mm."
    return ""


def read_p999_mm(evaluate: Task) -> float:
    """Read the 99.9th percentile of the error from the evaluation of a task, mm.

    Raises:
        ManifestError: the evaluation is damaged.
    """
    try:
        return finite_float(read_json(evaluate.folder / EVALUATION)["fdda"]["p999"])
    except (OSError, LookupError, TypeError, ValueError, ArithmeticError) as error:
        raise _damaged_error(evaluate, EVALUATION, error) from error


def _read_verdict(train: Task) -> object:
    """Read the verdict on the accuracy goal from the report of a training; None without an accuracy goal."""
    try:
        return read_json(train.folder / REPORT[0]).get("goal", {}).get("verdict")
    except (OSError, AttributeError, ValueError) as error:
        raise _damaged_error(train, REPORT[0], error) from error


def _damaged_error(task: Task, name: str, error: Exception) -> ManifestError:
    """Return the exception for a damaged output, and mark its task as not done."""
    task.manifest.unlink(missing_ok=True)
    return ManifestError(f"'{task.folder / name}' is damaged ({error}); run the farm again to restore it.")


def _run_verbs(
    tasks: dict[str, Task], task: Task, key: str, run_one_verb: Callable[[tuple[str, ...]], ProcessResult]
) -> TaskManifest:
    """Prepare the folder of a task, run its verbs and publish its outputs; return its manifest."""
    notes = {}
    _check_inputs(tasks, task)
    _prepare_folder(task, key)
    if task.kind == BIND:
        notes["bound"] = _copy_best_models(tasks, task)
    for source, name in task.copies:
        _copy_output(source, task.folder / name)
    started, peak_mb = time.monotonic(), 0.0
    for verb in task.verbs:
        peak_mb = max(peak_mb, run_one_verb(verb).peak_mb)
    seconds = time.monotonic() - started
    outputs = digest_outputs(task)
    for name, destination in task.publishes:
        _copy_output(task.folder / name, destination)
    return TaskManifest(key, outputs, "", round(seconds, 3), round(peak_mb, 1), socket.gethostname(), notes)


def _check_inputs(tasks: dict[str, Task], task: Task) -> None:
    """Check the outputs of earlier tasks that this task uses."""
    arguments = [argument for verb in task.verbs for argument in verb] + [str(source) for source, _ in task.copies]
    for name in task.after:
        previous = tasks[name]
        manifest = read_manifest(previous)
        if manifest is not None and manifest.skipped:
            continue
        used_paths = tuple(path for path in arguments if Path(path).is_relative_to(previous.folder))
        # A task may use only one mesh of a recording, or a model without its reports.
        names = tuple(Path(path).relative_to(previous.folder).as_posix() for path in used_paths)
        uses_all = task.kind == BIND
        check_outputs(previous, lambda file, names=names, uses_all=uses_all: uses_all or _is_inside(file, names))


def _is_inside(file: str, names: tuple[str, ...]) -> bool:
    return any(file == name or file.startswith(f"{name}/") for name in names)


def _prepare_folder(task: Task, key: str) -> None:
    """Prepare the folder of a task: keep partial work that has the same inputs, remove all other files."""
    fingerprint_file = task.folder / FINGERPRINT_FILE
    if not fingerprint_file.is_file():
        check_task_folder_free(task)
    task.manifest.unlink(missing_ok=True)
    # This process holds the lock, so partial folders are from killed processes.
    for partial in (
        *task.folder.parent.glob(f".new-{task.folder.name}-*"),
        *task.folder.parent.glob(f".old-{task.folder.name}-*"),
    ):
        shutil.rmtree(partial, ignore_errors=True)
    if task.folder.exists() and fingerprint_file.read_bytes() != key.encode():
        old_folder = task.folder.with_name(f".old-{task.folder.name}-{os.getpid()}")
        os.replace(task.folder, old_folder)
        shutil.rmtree(old_folder, ignore_errors=True)
    for path in task.folder.rglob("*") if task.folder.exists() else ():
        if is_temporary_name(path.name) or path.name == "recording.lock":
            path.unlink(missing_ok=True)
    if not task.folder.exists():
        new_folder = task.folder.with_name(f".new-{task.folder.name}-{os.getpid()}")
        new_folder.mkdir(parents=True)
        # The log is from runs with other inputs.
        task.log.unlink(missing_ok=True)
        write_text(new_folder / FINGERPRINT_FILE, key)
        os.replace(new_folder, task.folder)


def _copy_best_models(tasks: dict[str, Task], task: Task) -> dict[str, str]:
    """Copy the best model of all rounds with its reports, for each mesh.

    Returns:
        For each model file, the name of the task that trained it.
    """
    train_names = {}
    for destination, rounds in task.choices:
        evaluated_rounds = [(train, evaluate) for train, evaluate in rounds if not read_manifest(tasks[train]).skipped]
        train, evaluate = min(evaluated_rounds, key=lambda pair: read_p999_mm(tasks[pair[1]]))
        model_path = task.folder / destination
        model_path.parent.mkdir(parents=True, exist_ok=True)
        _copy_output(tasks[train].folder / model_path.name, model_path)
        for name in REPORT:
            _copy_output(tasks[train].folder / name, model_path.with_name(name))
        _copy_output(tasks[evaluate].folder / EVALUATION, model_path.with_name(EVALUATION))
        train_names[destination] = train
    return train_names


def _copy_output(source: Path, target: Path) -> None:
    """Copy a file or a folder. An existing target folder is kept, because it may hold partial work.

    Raises:
        OutputError: a file cannot be written.
        OSError: a folder cannot be written.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    if not source.is_dir():
        with atomic_write(target) as temporary:
            shutil.copyfile(source, temporary)
        return
    if target.exists():
        return
    new_folder = target.with_name(f".new-{target.name}-{os.getpid()}")
    with contextlib.suppress(FileNotFoundError):
        shutil.rmtree(new_folder)
    try:
        shutil.copytree(source, new_folder, ignore=shutil.ignore_patterns("*.lock"))
        os.replace(new_folder, target)
    finally:
        shutil.rmtree(new_folder, ignore_errors=True)
