# SPDX-License-Identifier: GPL-3.0-or-later
"""The job type for Flamenco: its compileJob runs under node, against a stub of what Flamenco's manual gives scripts."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from farm.__main__ import main
from farm.fingerprints import read_manifest
from farm.tasks import make_tasks

from .conftest import ONE, ROOT

SCRIPT = ROOT / "farm" / "flamenco_job" / "fdda_characters.js"
STUB = """
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
pytestmark = pytest.mark.skipif(not shutil.which("node"), reason="there is no node here")


def compiled(job: dict) -> dict:
    command = ["node", "-e", STUB, str(SCRIPT)]
    result = subprocess.run(command, input=json.dumps(job), capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def job_of(plan) -> dict:
    path = plan.path.with_name("job.json")
    assert main([str(plan.path), "--flamenco", str(path)]) == 0
    return json.loads(path.read_text())


def test_the_tasks_are_the_graph(written):
    plan = written(ONE + "goal_mm = 1\nrounds = 2\n")
    tasks = make_tasks(plan)
    made = {task["name"]: task for task in compiled(job_of(plan))["tasks"]}
    assert list(made) == [*tasks, "report"]
    assert {name: tuple(made[name]["dependencies"]) for name in tasks} == {n: t.after for n, t in tasks.items()}
    assert made["report"]["dependencies"] == ["elbow/bind"]
    types = {made[name]["type"] for name in tasks}
    assert types == {"blender", "misc", "file-management"} and made["elbow/train-0"]["type"] == "misc"


def test_settings_are_those_that_the_job_type_has(written):
    job = job_of(written())
    settings = {setting["key"]: setting for setting in compiled(job)["type"]["settings"]}
    assert set(job["settings"]) == set(settings) and job["type"] == SCRIPT.stem.replace("_", "-")
    kinds = {"string": str, "bool": bool}
    assert all(isinstance(job["settings"][key], kinds[own["type"]]) for key, own in settings.items())


def test_its_commands_do_the_tasks(written):
    """What a worker would start, started from another folder and with no environment of ours."""
    plan = written()
    made = {task["name"]: task for task in compiled(job_of(plan))["tasks"]}
    command = made["elbow/influences"]["commands"][0]
    assert command["name"] == "exec" and command["parameters"]["exe"] == sys.executable
    start = [command["parameters"]["exe"], *command["parameters"]["args"]]
    result = subprocess.run(start, cwd=Path("/"), capture_output=True, text=True, check=False)
    assert result.returncode == 0 and "elbow/influences: done" in result.stdout, result.stderr
    assert read_manifest(make_tasks(plan)["elbow/influences"]) is not None


def test_trainings_go_to_workers_with_a_gpu(written):
    made = compiled(job_of(written(ONE, "[farm]\ngpu = true\n")))["tasks"]
    assert [task["name"] for task in made if task["type"] == "fdda-gpu"] == ["elbow/train-0"]


@pytest.mark.parametrize(
    ("graph", "words"),
    [
        ([], "has no tasks; write the job with farm --flamenco"),
        ([{"name": "a", "kind": "bake", "after": []}], "is of the kind bake, which this job type does not know"),
        ([{"name": "a", "kind": "toString", "after": []}], "is of the kind toString"),
        ([{"name": "a", "kind": "bind", "after": ["b"]}], "waits for b, which is not before it"),
    ],
)
def test_a_graph_that_makes_no_sense_is_refused(written, graph, words):
    job = job_of(written())
    job["settings"]["graph"] = json.dumps(graph)
    assert words in compiled(job)["thrown"]
