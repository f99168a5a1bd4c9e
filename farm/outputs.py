# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks of what a farm may overwrite: no inputs, no files of another kind, no bound file that was edited."""

import os
from collections.abc import Iterable
from pathlib import Path

from fdda_addon.core.errors import OutputError
from fdda_addon.core.file_kind import BLEND, EVALUATION, MODEL, PAGE, PICTURE, REPORT, FileKind
from fdda_addon.core.output import check_folder_writable, check_outputs

from .characters import Plan, PlanError
from .fingerprints import digest_file, read_manifest
from .tasks import Task

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
"""By the whole name, or by its ending."""


def check_farm_outputs(
    plan: Plan,
    tasks: Iterable[Task],
    own: Iterable[tuple[Path, FileKind]],
    overwrite: bool = False,
    runs: bool = False,
) -> None:
    """Check before the work that the farm overwrites no other data.

    Args:
        plan: whose files are read.
        tasks: of the plan, with what they publish.
        own: what the farm itself writes, and of which kind that is.
        overwrite: the user said that files of another kind may be written over; those that are read never are.
        runs: the tasks are to run, and write as well.

    Raises:
        PlanError: a file that is read or written lies where a task keeps its own.
        OutputError: as `core.output.check_outputs`.
    """
    tasks, own = list(tasks), list(own)
    read = [plan.path, *(path for each in plan.characters for path in (each.rig, *each.depends))]
    published = [(place, published_kind(name)) for task in tasks for name, place in task.publishes]
    kept = {
        os.path.realpath(path): path for task in tasks for path in (task.folder, task.manifest, task.log, task.lock)
    }
    for path in (*read, *(path for path, _ in (*own, *published))):
        real = Path(os.path.realpath(path))
        if taken := next((kept[str(one)] for one in (real, *real.parents) if str(one) in kept), None):
            raise PlanError(f"'{path}' lies where the farm keeps '{taken}'; move it, or give [farm] another work.")
    places: set[str] = set()
    for path, _ in (*own, *published):
        place = os.path.realpath(path)
        if place in places:
            raise OutputError(
                f"Cannot write '{path}': two files would have this name; give each character an output of its own, and "
                "the report another place."
            )
        places.add(place)
    _check_files([*own, *(published if runs else ())], read, overwrite)


def check_published(task: Task, overwrite: bool = False) -> None:
    """Check before a task that its published files overwrite no other data.

    Raises:
        OutputError: a file is there that is of another kind, is read, or is a bound file that somebody has changed.
    """
    _check_files([(place, published_kind(name)) for name, place in task.publishes], task.files, overwrite)
    manifest = None if overwrite else read_manifest(task)
    # Of the other files nobody makes anything: they are made again.
    bound = [(name, place) for name, place in task.publishes if published_kind(name) is BLEND and os.path.exists(place)]
    for name, place in bound if manifest else ():
        if os.path.getsize(place) and digest_file(place) != manifest.outputs.get(name):
            raise OutputError(
                f"Cannot write '{place}': somebody has changed it since the farm made it; move it, or --overwrite."
            )


def check_task_folder_free(task: Task) -> None:
    """Check that the folder of a task has no files from elsewhere, which would be removed.

    Raises:
        OutputError: there are.
    """
    if os.path.lexists(task.folder):
        raise OutputError(f"'{task.folder}' is there, and not from the farm; move it, or give [farm] another work.")
    check_outputs([(task.manifest, MANIFEST), (task.log, LOG)])


def _check_files(outputs: list[tuple[Path, FileKind]], read: Iterable[Path], overwrite: bool) -> None:
    for path, _ in outputs:
        if os.path.exists(path) and any(os.path.exists(one) and os.path.samefile(path, one) for one in read):
            raise OutputError(f"Cannot write '{path}': the farm reads it; give another name, or another output.")
        # A folder that is not there yet is made when there is something to put into it.
        if not os.path.isdir(path.parent):
            check_folder_writable(path.parent)
    check_outputs([one for one in outputs if os.path.isdir(one[0].parent)], (), overwrite)


def published_kind(name: str) -> FileKind:
    """Return the kind of a published file."""
    path = Path(name)
    return PUBLISHED_KINDS.get(path.name) or PUBLISHED_KINDS[path.suffix]
