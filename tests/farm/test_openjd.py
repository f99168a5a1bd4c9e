# SPDX-License-Identifier: GPL-3.0-or-later
"""Tests of the OpenJD job template: openjd-cli checks it, and runs it on the elbow with real verbs."""

import json
import subprocess
import sys
from pathlib import Path

from farm.__main__ import main
from farm.fingerprints import read_manifest
from farm.openjd import make_template
from farm.tasks import make_tasks

from .conftest import ONE_CHARACTER

FIFTY_CHARACTERS = "".join(
    f'[characters.c{n}]\nrig = "elbow.blend"\noutput = "out/{n}"\ngoal_mm = 1\n' for n in range(50)
)


def run_openjd(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [Path(sys.executable).with_name("openjd"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def write_template(plan) -> Path:
    """Write the job template of a plan with the command line; return its path."""
    path = plan.path.with_suffix(".json")
    assert main([str(plan.path), "--openjd", str(path)]) == 0
    return path


def test_templates_are_valid(write_plan):
    for text in (
        ONE_CHARACTER,
        ONE_CHARACTER + "shards = 1\n",
        ONE_CHARACTER + 'objects = ["a", "b c"]\ngoal_mm = 1\n',
        FIFTY_CHARACTERS,
    ):
        checked = run_openjd("check", write_template(write_plan(text)))
        assert "passes validation checks" in checked.stdout, checked.stdout + checked.stderr


def test_the_steps_and_dependencies_are_the_graph(write_plan):
    plan = write_plan(ONE_CHARACTER + "shards = 3\n")
    template = make_template(plan, make_tasks(plan), plan.path.parent)
    steps = {step["name"]: step for step in template["steps"]}
    assert list(steps) == [
        *(f"elbow/{n}" for n in ("influences", "record", "merge", "train-0", "evaluate-0", "bind")),
        "report",
    ]
    assert steps["elbow/record"]["parameterSpace"]["taskParameterDefinitions"][0]["range"] == "1-3"
    assert steps["elbow/merge"]["dependencies"] == [{"dependsOn": "elbow/record"}]
    assert steps["report"]["dependencies"] == [{"dependsOn": "elbow/bind"}]
    assert template["parameterDefinitions"][0]["default"] == "characters.toml"


def test_trainings_require_a_gpu_where_the_plan_needs_a_gpu(write_plan):
    plan = write_plan(ONE_CHARACTER, "[farm]\ngpu = true\n")
    steps = make_template(plan, make_tasks(plan), plan.path.parent)["steps"]
    gpu_steps = [step["name"] for step in steps if "hostRequirements" in step]
    assert gpu_steps == ["elbow/train-0"]


def test_openjd_runs_a_step_and_its_dependencies(write_plan):
    plan = write_plan()
    run = run_openjd("run", write_template(plan), "--step", "elbow/merge", "--run-dependencies")
    assert run.returncode == 0, run.stdout[-3000:] + run.stderr
    done = [name for name, task in make_tasks(plan).items() if read_manifest(task)]
    assert done == ["elbow/influences", "elbow/record-1", "elbow/record-2", "elbow/merge"]


def test_a_failed_task_fails_its_step(write_plan, tmp_path):
    plan = write_plan()
    (tmp_path / "elbow.blend").write_text("no rig")
    run = run_openjd("run", write_template(plan), "--step", "elbow/influences")
    assert run.returncode != 0 and "Error: Blender cannot open" in run.stdout


def test_the_report_is_written_by_its_step(write_plan):
    plan = write_plan()
    run = run_openjd("run", write_template(plan), "--step", "report")
    assert run.returncode == 0, run.stdout[-3000:] + run.stderr
    report = json.loads(plan.path.with_name("report.json").read_text())
    assert report["characters"]["elbow"]["state"] == "not done"
