# SPDX-License-Identifier: GPL-3.0-or-later
"""The job template: checked by openjd-cli, and run by it on the elbow with real verbs."""

import json
import subprocess
import sys
from pathlib import Path

from farm.__main__ import main
from farm.fingerprints import read_manifest
from farm.openjd import make_template
from farm.tasks import make_tasks

from .conftest import ONE

MANY = "".join(f'[characters.c{n}]\nrig = "elbow.blend"\noutput = "out/{n}"\ngoal_mm = 1\n' for n in range(50))


def openjd(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [Path(sys.executable).with_name("openjd"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def template_of(plan) -> Path:
    path = plan.path.with_suffix(".json")
    assert main([str(plan.path), "--openjd", str(path)]) == 0
    return path


def test_templates_are_valid(written):
    for text in (ONE, ONE + "shards = 1\n", ONE + 'objects = ["a", "b c"]\ngoal_mm = 1\n', MANY):
        checked = openjd("check", template_of(written(text)))
        assert "passes validation checks" in checked.stdout, checked.stdout + checked.stderr


def test_the_steps_are_the_graph(written):
    plan = written(ONE + "shards = 3\n")
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


def test_trainings_ask_for_a_gpu_where_the_plan_does(written):
    plan = written(ONE, "[farm]\ngpu = true\n")
    steps = make_template(plan, make_tasks(plan), plan.path.parent)["steps"]
    asking = [step["name"] for step in steps if "hostRequirements" in step]
    assert asking == ["elbow/train-0"]


def test_it_runs(written):
    plan = written()
    run = openjd("run", template_of(plan), "--step", "elbow/merge", "--run-dependencies")
    assert run.returncode == 0, run.stdout[-3000:] + run.stderr
    done = [name for name, task in make_tasks(plan).items() if read_manifest(task)]
    assert done == ["elbow/influences", "elbow/record-1", "elbow/record-2", "elbow/merge"]


def test_a_task_that_fails_fails_there(written, tmp_path):
    plan = written()
    (tmp_path / "elbow.blend").write_text("no rig")
    run = openjd("run", template_of(plan), "--step", "elbow/influences")
    assert run.returncode != 0 and "Error: Blender cannot open" in run.stdout


def test_the_report_is_written_by_its_step(written):
    plan = written()
    run = openjd("run", template_of(plan), "--step", "report")
    assert run.returncode == 0, run.stdout[-3000:] + run.stderr
    report = json.loads(plan.path.with_name("report.json").read_text())
    assert report["characters"]["elbow"]["state"] == "not done"
