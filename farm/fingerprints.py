# SPDX-License-Identifier: GPL-3.0-or-later
"""Fingerprints of the inputs and outputs of tasks, which show whether a task is up to date."""

import hashlib
import json
import math
import tomllib
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path

from fdda_addon.core.errors import FDDAError
from fdda_addon.core.input_file import read_input
from fdda_addon.core.output import is_temporary_name, write_json

from .characters import Farm
from .task import Task
from .tasks import TRAIN

FORMAT, VERSION = "fdda-farm-task", 1
MAX_JSON_BYTES = 64 << 20
MAX_RECORDED_VALUE = 1e12
ROOT = Path(__file__).resolve().parent.parent
READ_CHUNK_BYTES = 4 << 20


class ManifestError(FDDAError):
    """Outputs of a task are missing or were changed since it finished."""


@dataclass(frozen=True)
class TaskManifest:
    """Manifest of a finished task.

    Attributes:
        key: fingerprint of the inputs of the task.
        outputs: size in bytes and SHA-256 of each output file, by its name relative to the folder of the task.
        skipped: reason why the task was skipped; empty where it ran.
        seconds: wall-clock time of its verbs.
        peak_mb: peak memory of its largest process.
        host: name of the machine.
        notes: values for the report, such as the task whose model was bound.
    """

    key: str
    outputs: dict[str, tuple[int, str]]
    skipped: str = ""
    seconds: float = 0.0
    peak_mb: float = 0.0
    host: str = ""
    notes: dict = field(default_factory=dict)


def read_json(path: Path) -> dict:
    """Read a JSON object from a file; refuse NaN and infinity.

    Raises:
        OSError: the file cannot be read, or is too large.
        ValueError: the file holds no valid JSON object.
    """
    try:
        value = json.loads(read_input(path, MAX_JSON_BYTES), parse_constant=finite_float, parse_float=finite_float)
    except RecursionError as error:
        raise ValueError("the JSON is nested too deeply") from error
    if not isinstance(value, dict):
        raise ValueError("the JSON is not an object")
    return value


def finite_float(value: object) -> float:
    """Convert a number to a finite float.

    Raises:
        ValueError: the value is not a number, NaN, or infinite.
    """
    if isinstance(value, bool) or not isinstance(value, int | float | str) or not math.isfinite(number := float(value)):
        raise ValueError(f"{value!r} is not a finite number")
    return number


def read_manifest(task: Task) -> TaskManifest | None:
    """Read the manifest of a task; return None where it is missing or invalid, which means that the task must run."""
    try:
        value = read_json(task.manifest)
        if (value["format"], value["version"]) != (FORMAT, VERSION):
            return None
        outputs = {name: (int(size), str(digest)) for name, (size, digest) in value["outputs"].items()}
        texts = [value[name] for name in ("key", "skipped", "host")]
        if not all(isinstance(text, str) for text in texts) or not isinstance(value["notes"], dict):
            return None
        seconds, peak_mb = finite_float(value["seconds"]), finite_float(value["peak_mb"])
        if not (0 <= seconds < MAX_RECORDED_VALUE and 0 <= peak_mb < MAX_RECORDED_VALUE):
            return None
        return TaskManifest(texts[0], outputs, texts[1], seconds, peak_mb, texts[2], value["notes"])
    except (OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError):
        return None


def write_manifest(task: Task, manifest: TaskManifest) -> None:
    """Write the manifest of a finished task.

    Raises:
        OutputError: the disk is full.
    """
    write_json(task.manifest, {"format": FORMAT, "version": VERSION, **asdict(manifest)})


def digest_file(path: Path) -> tuple[int, str]:
    """Compute the size and the SHA-256 of a file.

    Raises:
        OSError: the file cannot be read.
    """
    digest, size = hashlib.sha256(), 0
    with open(path, "rb") as file:
        while chunk := file.read(READ_CHUNK_BYTES):
            digest.update(chunk)
            size += len(chunk)
    return size, digest.hexdigest()


def list_output_files(folder: Path, names: Iterable[str]) -> dict[str, Path]:
    """List the output files of a task, also those in output folders, by their names relative to its folder."""
    files_by_name = {}
    for name in names:
        path = folder / name
        files = sorted(filter(_is_output_file, path.rglob("*"))) if path.is_dir() else [path]
        files_by_name |= {file.relative_to(folder).as_posix(): file for file in files}
    return files_by_name


def _is_output_file(path: Path) -> bool:
    """Return whether a path is a file, but neither a lock nor a temporary file."""
    return path.is_file() and path.suffix != ".lock" and not is_temporary_name(path.name)


def digest_outputs(task: Task) -> dict[str, tuple[int, str]]:
    """Compute the size and the SHA-256 of all output files of a task.

    Raises:
        ManifestError: an output is missing.
    """
    try:
        return {name: digest_file(path) for name, path in list_output_files(task.folder, task.outputs).items()}
    except OSError as error:
        raise ManifestError(f"'{task.name}' ended without '{error.filename}' ({error.strerror}).") from error


def outputs_are_intact(task: Task, manifest: TaskManifest) -> bool:
    """Return whether outputs and published copies are unchanged since the task finished."""
    published = {path: manifest.outputs.get(name) for name, path in task.publishes if not manifest.skipped}
    expected = {task.folder / name: output for name, output in manifest.outputs.items()} | published
    try:
        # Compare sizes first: most changed files are missing or have another size, and need not be read.
        return all(output and path.stat().st_size == output[0] for path, output in expected.items()) and all(
            digest_file(path) == output for path, output in expected.items()
        )
    except OSError:
        return False


def check_outputs(task: Task, is_used: Callable[[str], bool] = lambda _: True) -> TaskManifest:
    """Check that the outputs of a task are unchanged before another task reads them.

    Args:
        task: the task that made the outputs.
        is_used: returns whether the output with a name has to be checked.

    Raises:
        ManifestError: the task is not done, or an output was changed.
    """
    manifest = read_manifest(task)
    if manifest is None:
        raise ManifestError(f"'{task.name}' is not done; run the farm again.")
    for name, expected in manifest.outputs.items():
        if not is_used(name):
            continue
        path = task.folder / name
        try:
            actual = digest_file(path)
        except OSError as error:
            actual = (-1, str(error.strerror))
        if actual != expected:
            task.manifest.unlink(missing_ok=True)
            raise ManifestError(
                f"'{path}' was changed since '{task.name}' wrote it ({actual[0]:,} bytes, before {expected[0]:,}); "
                "run the farm again to restore it."
            )
    return manifest


class InputFingerprints:
    """Computes fingerprints of the inputs of tasks: verbs, external files, settings, and earlier tasks."""

    def __init__(self, farm: Farm, tasks: dict[str, Task]):
        self._farm, self._tasks = farm, tasks
        self._keys: dict[str, str] = {}
        self._file_digests: dict[Path, tuple[int, str]] = {}

    def of_task(self, name: str) -> str:
        """Return the fingerprint of the inputs of a task.

        Raises:
            ManifestError: an external file cannot be read.
        """
        if name not in self._keys:
            task = self._tasks[name]
            files = [self._file_digest(path) for path in task.files]
            previous = [self.of_task(dependency) for dependency in task.after]
            task_settings = [
                _to_relative_texts(str(self._farm.work), task.verbs),
                list(task.outputs),
                task.poses,
                str(task.round),
            ]
            # Settings of the machine are part of the fingerprint where they change the result.
            settings = [self._farm.threads, self._farm.gpu, self._farm.trainer_python] if task.kind == TRAIN else []
            programs = [self._farm.python, self._farm.blender, addon_version()]
            text = json.dumps(
                [
                    task_settings,
                    _to_relative_texts(str(self._farm.work), task.publishes),
                    settings,
                    programs,
                    files,
                    previous,
                ]
            )
            self._keys[name] = hashlib.sha256(text.encode()).hexdigest()
        return self._keys[name]

    def _file_digest(self, path: Path) -> tuple[int, str]:
        if path not in self._file_digests:
            try:
                self._file_digests[path] = digest_file(path)
            except OSError as error:
                raise ManifestError(f"There is no file '{path}' ({error.strerror}); see the plan.") from error
        return self._file_digests[path]


def _to_relative_texts(folder: str, values: tuple) -> list:
    """Convert tuples to lists of texts without the path of the work folder, which may be moved."""
    return [[str(item).replace(folder, "") for item in value] for value in values]


@cache
def addon_version() -> str:
    """Return the version of the add-on."""
    try:
        return str(tomllib.loads((ROOT / "blender_manifest.toml").read_text(encoding="utf-8"))["version"])
    except (OSError, ValueError, KeyError):
        return ""


def outdated_tasks(tasks: dict[str, Task], fingerprints: InputFingerprints) -> tuple[list[str], dict[str, str]]:
    """Find the tasks that have to run, and tasks whose inputs cannot be read.

    The search goes backwards from the last tasks: a task that is up to date needs no earlier task.

    Returns:
        The names of the tasks to run, in the order of `tasks`; and an error message for each task whose external files
        cannot be read.
    """
    outdated: set[str] = set()
    unreadable: dict[str, str] = {}
    pending = [name for name in tasks if not any(name in task.after for task in tasks.values())]
    visited = set(pending)
    while pending:
        name = pending.pop()
        try:
            is_done = is_up_to_date(tasks[name], fingerprints.of_task(name))
        except ManifestError as error:
            unreadable[name] = str(error)
            continue
        if not is_done:
            outdated.add(name)
            for dependency in tasks[name].after:
                if dependency not in visited:
                    visited.add(dependency)
                    pending.append(dependency)
    return [name for name in tasks if name in outdated], unreadable


def is_up_to_date(task: Task, key: str) -> bool:
    """Return whether a task finished with these inputs and its outputs are unchanged."""
    manifest = read_manifest(task)
    return manifest is not None and manifest.key == key and outputs_are_intact(task, manifest)
