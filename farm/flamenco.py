# SPDX-License-Identifier: GPL-3.0-or-later
"""Export of the graph as a job for Flamenco, of the job type `flamenco_job/fdda_characters.js`."""

import json
import sys
from pathlib import Path

from fdda_addon.core.output import write_json

from .characters import Plan
from .fingerprints import ROOT
from .task import Task

JOB_TYPE = "fdda-characters"
"""Name of the job type: Flamenco takes the name of the script, with - for _."""
JOB_PRIORITY = 50


def write_job(plan: Plan, tasks: dict[str, Task], path: Path) -> int:
    """Write the job of a plan as a file for `POST /api/v3/jobs` of Flamenco's manager; return the exit status.

    Raises:
        OutputError: the file cannot be written.
    """
    write_json(path, make_job(plan, tasks))
    print(f"{path}: a job of {len(tasks) + 1} tasks")
    return 0


def make_job(plan: Plan, tasks: dict[str, Task]) -> dict:
    """Make the job. A Flamenco job type cannot read files, so the graph is a setting of the job."""
    graph = [{"name": task.name, "kind": task.kind, "after": list(task.after)} for task in tasks.values()]
    return {
        "name": f"FDDA {plan.path.stem}",
        "type": JOB_TYPE,
        "priority": JOB_PRIORITY,
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
