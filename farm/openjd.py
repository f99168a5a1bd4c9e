# SPDX-License-Identifier: GPL-3.0-or-later
"""Export of the graph as a job template of Open Job Description (OpenJD), for render-farm managers."""

import sys
from pathlib import Path

from fdda_addon.core.output import write_json

from .characters import Plan
from .fingerprints import ROOT
from .task import Task
from .tasks import BIND, RECORD, TRAIN

SPECIFICATION_VERSION = "jobtemplate-2023-09"
SHARD_PARAMETER = "Shard"


def write_template(plan: Plan, tasks: dict[str, Task], path: Path) -> int:
    """Write the template of a plan; return the exit status.

    Raises:
        OutputError: the file cannot be written.
    """
    template = make_template(plan, tasks, path.absolute().parent)
    write_json(path, template)
    print(f"{path}: a template of {len(template['steps'])} steps")
    return 0


def make_template(plan: Plan, tasks: dict[str, Task], folder: Path) -> dict:
    """Make the template: one step per task, but one step for all shards of a recording, and a last step for the report.

    Args:
        plan, tasks: the graph.
        folder: folder of the template. Where the plan is inside it, the plan is the default of the parameter Plan.
    """
    steps = [_step(plan, tasks, task) for task in tasks.values() if task.kind != RECORD or task.name.endswith("-1")]
    bind_dependencies = [{"dependsOn": step_name(task)} for task in tasks.values() if task.kind == BIND]
    steps.append({"name": "report", "dependencies": bind_dependencies, "script": _script("--report-only")})
    return {
        "specificationVersion": SPECIFICATION_VERSION,
        "name": f"FDDA {plan.path.stem}"[:128],
        "parameterDefinitions": [
            _plan_parameter(plan, folder),
            _text_parameter("Project", str(ROOT), "the folder of FDDA for Blender on the workers"),
            _text_parameter("Python", sys.executable, "Python of the workers that has the packages of the project"),
        ],
        "jobEnvironments": [{"name": "FDDA", "variables": {"PYTHONPATH": "{{Param.Project}}"}}],
        "steps": steps,
    }


def _plan_parameter(plan: Plan, folder: Path) -> dict:
    # OpenJD only allows default paths that are relative to the template and inside its folder.
    is_inside = plan.path.is_relative_to(folder)
    return {
        "name": "Plan",
        "type": "PATH",
        "objectType": "FILE",
        # The plan is not copied to the workers, because tasks exchange files in the shared folder that it names.
        "dataFlow": "NONE",
        **({"default": plan.path.relative_to(folder).as_posix()} if is_inside else {}),
        "description": "characters.toml, in a folder that all workers can read",
    }


def _text_parameter(name: str, default: str, description: str) -> dict:
    return {"name": name, "type": "STRING", "default": default, "description": description}


def step_name(task: Task) -> str:
    """Return the name of the step of a task; the shards of a recording share a step."""
    return task.name.rpartition("-")[0] if task.kind == RECORD else task.name


def _step(plan: Plan, tasks: dict[str, Task], task: Task) -> dict:
    dependencies = list(dict.fromkeys(step_name(tasks[name]) for name in task.after))
    step = {"name": step_name(task), "script": _script("--task", task.name)}
    if task.kind == RECORD:
        shards = sum(other.kind == RECORD and step_name(other) == step["name"] for other in tasks.values())
        step["script"] = _script("--task", f"{step['name']}-{{{{Task.Param.{SHARD_PARAMETER}}}}}")
        step["parameterSpace"] = {
            "taskParameterDefinitions": [
                {"name": SHARD_PARAMETER, "type": "INT", "range": f"1-{shards}" if shards > 1 else "1"}
            ]
        }
    if dependencies:
        step["dependencies"] = [{"dependsOn": name} for name in dependencies]
    if task.kind == TRAIN and plan.farm.gpu:
        step["hostRequirements"] = {"amounts": [{"name": "amount.worker.gpu", "min": 1}]}
    return step


def _script(*options: str) -> dict:
    arguments = ["-P", "-m", "farm", "{{Param.Plan}}", *options]
    return {"actions": {"onRun": {"command": "{{Param.Python}}", "args": arguments}}}
