# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks that the farm overwrites no inputs, no files of another kind, and no bound file that was edited."""

import os
from collections.abc import Iterable
from pathlib import Path

from fdda_addon.core.errors import OutputError
from fdda_addon.core.file_kind import BLEND, EVALUATION, MODEL, PAGE, PICTURE, REPORT, FileKind
from fdda_addon.core.output import check_folder_writable, check_outputs

from .characters import Plan, PlanError
from .fingerprints import digest_file, read_manifest
from .task import Task

FARM_REPORT = FileKind("the report of a farm", rb'\s*\{\s*"format":\s*"fdda-farm-report"')
FARM_PAGE = FileKind("the page of the report of a farm", rb"<!doctype html>.*: characters</title>")
TEMPLATE = FileKind("an OpenJD job template", rb'\s*\{\s*"specificationVersion":\s*"jobtemplate-')
JOB = FileKind("a job for Flamenco", rb'\s*\{\s*"name":\s*"(?:[^"\\]|\\.)*",\s*"type":\s*"fdda-characters"')
MANIFEST = FileKind("the fingerprint of a task", rb'\s*\{\s*"format":\s*"fdda-farm-task"')
LOG = FileKind("the log of a task", rb"\$ ")
PUBLISHED_KINDS = {
    **{".blend": BLEND, ".onnx": MODEL, ".png": PICTURE, "report.json": REPORT},
    **{"report.html": PAGE, "evaluation.json": EVALUATION},
}
"""Kinds of published files, by file name or by suffix."""


def check_farm_outputs(
    plan: Plan,
    tasks: Iterable[Task],
    farm_files: Iterable[tuple[Path, FileKind]],
    overwrite: bool = False,
    runs_tasks: bool = False,
) -> None:
    """Check before any work that the farm overwrites no files of the user.

    Args:
        plan: the plan, which names the files that the farm reads.
        tasks: tasks of the plan, which name the files that they publish.
        farm_files: files that the farm itself writes, with their kinds.
        overwrite: whether the user allows to replace files of another kind. Inputs are never replaced.
        runs_tasks: whether the tasks will run, and write files as well.

    Raises:
        PlanError: an input or an output is inside the folder of a task.
        OutputError: an output would replace a file; see `core.output.check_outputs`.
    """
    tasks, farm_files = list(tasks), list(farm_files)
    inputs = [plan.path, *(path for each in plan.characters for path in (each.rig, *each.depends))]
    published = [(destination, published_kind(name)) for task in tasks for name, destination in task.publishes]
    task_paths = {
        os.path.realpath(path): path for task in tasks for path in (task.folder, task.manifest, task.log, task.lock)
    }
    for path in (*inputs, *(path for path, _ in (*farm_files, *published))):
        real_path = Path(os.path.realpath(path))
        folders = map(str, (real_path, *real_path.parents))
        if task_path := next((task_paths[folder] for folder in folders if folder in task_paths), None):
            raise PlanError(f"'{path}' lies where the farm keeps '{task_path}'; move it, or give [farm] another work.")
    real_outputs: set[str] = set()
    for path, _ in (*farm_files, *published):
        real_output = os.path.realpath(path)
        if real_output in real_outputs:
            raise OutputError(
                f"Cannot write '{path}': two files would have this name; give each character an output of its own, and "
                "the report another folder."
            )
        real_outputs.add(real_output)
    _check_files([*farm_files, *(published if runs_tasks else ())], inputs, overwrite)


def check_published(task: Task, overwrite: bool = False) -> None:
    """Check before a task runs that its published files overwrite no files of the user.

    Raises:
        OutputError: an existing file is of another kind, is an input, or is a bound file that was edited.
    """
    outputs = [(destination, published_kind(name)) for name, destination in task.publishes]
    _check_files(outputs, task.files, overwrite)
    manifest = None if overwrite else read_manifest(task)
    # Only bound files are edited by users; other files may be overwritten.
    bound_files = [
        (name, path) for name, path in task.publishes if published_kind(name) is BLEND and os.path.exists(path)
    ]
    for name, path in bound_files if manifest else ():
        if os.path.getsize(path) and digest_file(path) != manifest.outputs.get(name):
            raise OutputError(
                f"Cannot write '{path}': it was edited since the farm wrote it; move it, or use --overwrite."
            )


def check_task_folder_free(task: Task) -> None:
    """Check that no other program made the folder of a task, because the farm would remove its files.

    Raises:
        OutputError: the folder exists, or its manifest or log is of another kind.
    """
    if os.path.lexists(task.folder):
        raise OutputError(f"The farm did not make '{task.folder}'; move it, or give [farm] another work.")
    check_outputs([(task.manifest, MANIFEST), (task.log, LOG)])


def _check_files(outputs: list[tuple[Path, FileKind]], inputs: Iterable[Path], overwrite: bool) -> None:
    for path, _ in outputs:
        if os.path.exists(path) and any(os.path.exists(file) and os.path.samefile(path, file) for file in inputs):
            raise OutputError(f"Cannot write '{path}': the farm reads it; give another name, or another output.")
        # A missing folder is made later, when its first file is written.
        if not os.path.isdir(path.parent):
            check_folder_writable(path.parent)
    check_outputs([output for output in outputs if os.path.isdir(output[0].parent)], (), overwrite)


def published_kind(name: str) -> FileKind:
    """Return the kind of a published file."""
    path = Path(name)
    return PUBLISHED_KINDS.get(path.name) or PUBLISHED_KINDS[path.suffix]
