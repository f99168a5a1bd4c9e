# SPDX-License-Identifier: GPL-3.0-or-later
"""Tests of the job type for Flamenco: node runs its compileJob with a stub of Flamenco's scripting API."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from farm.__main__ import main
from farm.fingerprints import read_manifest
from farm.tasks import make_tasks

from .conftest import ONE_CHARACTER, ROOT

SCRIPT = ROOT / "farm" / "flamenco_job" / "fdda_characters.js"
FLAMENCO_STUB = """
const fs = require("fs"), vm = require("vm");
const submitted = JSON.parse(fs.readFileSync(0, "utf8"));
const tasks = [];
class Task {
    constructor(name, type) { Object.assign(this, { name, type, commands: [], dependencies: [] }); }
    addCommand(command) { this.commands.push(command); }
    addDependency(task) {
        if (!(task instanceof Task)) throw "a dependency is no task";
        this.dependencies.push(task.name);
    }
}
const author = {
    Task: (name, type) => new Task(name, type),
    Command: (name, parameters) => ({ name, parameters }),
};
const context = vm.createContext({ author, print: () => {} });
const source = fs.readFileSync(process.argv[1], "utf8");
vm.runInContext(source + "; this.type = JOB_TYPE; this.compile = compileJob;", context);
try {
    context.compile({ ...submitted, created: new Date(), addTask: (task) => tasks.push(task) });
    console.log(JSON.stringify({ type: context.type, tasks }));
} catch (error) {
    console.log(JSON.stringify({ thrown: String(error) }));
}
"""
pytestmark = pytest.mark.skipif(not shutil.which("node"), reason="node is not installed")


def compile_job(job: dict) -> dict:
    """Run compileJob of the job type on a job; return its tasks and the job type, or the thrown message."""
    command = ["node", "-e", FLAMENCO_STUB, str(SCRIPT)]
    result = subprocess.run(command, input=json.dumps(job), capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def write_job(plan) -> dict:
    """Write the job of a plan with the command line, and read it."""
    path = plan.path.with_name("job.json")
    assert main([str(plan.path), "--flamenco", str(path)]) == 0
    return json.loads(path.read_text())


def test_the_compiled_tasks_and_dependencies_are_the_graph(write_plan):
    plan = write_plan(ONE_CHARACTER + "goal_mm = 1\nrounds = 2\n")
    tasks = make_tasks(plan)
    tasks_by_name = {task["name"]: task for task in compile_job(write_job(plan))["tasks"]}
    assert list(tasks_by_name) == [*tasks, "report"]
    assert {name: tuple(tasks_by_name[name]["dependencies"]) for name in tasks} == {
        n: t.after for n, t in tasks.items()
    }
    assert tasks_by_name["report"]["dependencies"] == ["elbow/bind"]
    types = {tasks_by_name[name]["type"] for name in tasks}
    assert types == {"blender", "misc", "file-management"} and tasks_by_name["elbow/train-0"]["type"] == "misc"


def test_the_settings_of_a_job_match_the_job_type(write_plan):
    job = write_job(write_plan())
    settings = {setting["key"]: setting for setting in compile_job(job)["type"]["settings"]}
    assert set(job["settings"]) == set(settings) and job["type"] == SCRIPT.stem.replace("_", "-")
    kinds = {"string": str, "bool": bool}
    assert all(isinstance(job["settings"][key], kinds[setting["type"]]) for key, setting in settings.items())


def test_the_command_of_a_task_runs_from_another_folder(write_plan):
    """Run the command as a Flamenco worker does: in another working directory, without PYTHONPATH."""
    plan = write_plan()
    tasks_by_name = {task["name"]: task for task in compile_job(write_job(plan))["tasks"]}
    command = tasks_by_name["elbow/influences"]["commands"][0]
    assert command["name"] == "exec" and command["parameters"]["exe"] == sys.executable
    arguments = [command["parameters"]["exe"], *command["parameters"]["args"]]
    result = subprocess.run(arguments, cwd=Path("/"), capture_output=True, text=True, check=False)
    assert result.returncode == 0 and "elbow/influences: done" in result.stdout, result.stderr
    assert read_manifest(make_tasks(plan)["elbow/influences"]) is not None


def test_trainings_have_the_gpu_task_type_where_the_plan_needs_a_gpu(write_plan):
    compiled_tasks = compile_job(write_job(write_plan(ONE_CHARACTER, "[farm]\ngpu = true\n")))["tasks"]
    assert [task["name"] for task in compiled_tasks if task["type"] == "fdda-gpu"] == ["elbow/train-0"]


@pytest.mark.parametrize(
    ("graph", "message"),
    [
        ([], "has no tasks; write the job with farm --flamenco"),
        ([{"name": "a", "kind": "bake", "after": []}], "is of the kind bake, which this job type does not know"),
        ([{"name": "a", "kind": "toString", "after": []}], "is of the kind toString"),
        ([{"name": "a", "kind": "bind", "after": ["b"]}], "waits for b, which is not before it"),
    ],
)
def test_an_invalid_graph_is_refused(write_plan, graph, message):
    job = write_job(write_plan())
    job["settings"]["graph"] = json.dumps(graph)
    assert message in compile_job(job)["thrown"]
