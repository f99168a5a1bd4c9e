# SPDX-License-Identifier: GPL-3.0-or-later
"""Export of the graph as a job for Flamenco, of the job type `flamenco_job/fdda_characters.js`."""

import json
import sys
from pathlib import Path

from fdda_addon.core.output import write_json

from .characters import Plan
from .fingerprints import ROOT
from .tasks import Task

JOB_TYPE = "fdda-characters"
"""Flamenco calls a job type as its file, with - for _."""
PRIORITY = 50


def write_job(plan: Plan, tasks: dict[str, Task], path: Path) -> int:
    """Write the job of a plan for `POST /api/v3/jobs` of the manager; return the exit status.

    Raises:
        OutputError: the file cannot be written.
    """
    write_json(path, make_job(plan, tasks))
    print(f"{path}: a job of {len(tasks) + 1} tasks")
    return 0


def make_job(plan: Plan, tasks: dict[str, Task]) -> dict:
    """Make the job. A job type cannot read files, so the graph is one of its settings."""
    graph = [{"name": task.name, "kind": task.kind, "after": list(task.after)} for task in tasks.values()]
    return {
        "name": f"FDDA {plan.path.stem}",
        "type": JOB_TYPE,
        "priority": PRIORITY,
        "submitter_platform": {"darwin": "darwin", "win32": "windows"}.get(sys.platform, "linux"),
        "metadata": {"project": "FDDA"},
        "settings": {
            "plan": str(plan.path),
            "python": sys.executable,
            "project": str(ROOT),
            "gpu": plan.farm.gpu,
            "graph": json.dumps(graph, separators=(",", ":")),
        },
    }
