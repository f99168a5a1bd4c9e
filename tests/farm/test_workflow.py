# SPDX-License-Identifier: GPL-3.0-or-later
"""Tests of the workflow: what runs, what runs again, what is refused, what a crash costs, and jobs of render farms."""

import contextlib
import json
import os
import random
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from .programs import PYTHON

ROOT = Path(__file__).resolve().parents[2]
PROGRAMS = [sys.executable, str(Path(__file__).with_name("programs.py"))]
DEFAULTS = {"record": {"poses": 20}, "train": {"passes": 2, "hidden": [8]}, "evaluate": {"poses": 4}}
STREAMS = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}


class Farm:
    """A folder with the elbow and a plan, and the workflow in it."""

    def __init__(self, folder: Path, **characters: dict):
        self.folder, self.calls, self.status = folder, folder / "calls", folder / "status"
        shutil.copyfile(ROOT / "blend_fixtures/elbow.blend", folder / "elbow.blend")
        program = shlex.join([*PROGRAMS, "run_verb", str(self.calls), str(self.status)])
        self.plan = {"program": program, "defaults": DEFAULTS, "characters": characters}

    def write_plan(self) -> Path:
        (self.folder / "characters.yaml").write_text(yaml.safe_dump(self.plan))
        return self.folder / "characters.yaml"

    def command(self, *options: str) -> list[str]:
        command = [sys.executable, "-m", "snakemake", "--snakefile", str(ROOT / "farm/Snakefile")]
        return [*command, "--configfile", str(self.write_plan()), "--jobs", "2", *options]

    def run(self, *options: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(self.command(*options), cwd=self.folder, check=False, **STREAMS)

    def new_calls(self) -> list[str]:
        """Return the verbs that have run since the last call, sorted."""
        lines = self.calls.read_text().splitlines() if self.calls.exists() else []
        self.calls.unlink(missing_ok=True)
        return sorted(line.split()[0] for line in lines)


def character(name: str, **settings) -> dict:
    return {"rig": "elbow.blend", "output": f"out/{name}", **settings}


def test_a_character_is_made_once_and_again_after_a_change(tmp_path):
    farm = Farm(tmp_path, elbow=character("elbow"), other=character("other"))
    run = farm.run("elbow")
    assert run.returncode == 0, run.stdout
    assert farm.new_calls() == ["bind", "evaluate", "record", "train"]
    output, work = tmp_path / "out/elbow", tmp_path / "farm/elbow"
    assert {path.name for path in output.rglob("*.*")} >= {"elbow.blend", "elbow.onnx", "report.html"}
    errors = json.loads((work / "evaluate/errors.json").read_text())
    assert errors["fdda"]["p999"] < 100 and (work / "evaluate/errors.png").is_file()

    os.utime(tmp_path / "elbow.blend")
    assert farm.run("elbow").returncode == 0 and farm.new_calls() == [], "the rig has the same content"
    (output / "elbow.blend").unlink()
    assert farm.run("elbow").returncode == 0 and farm.new_calls() == ["bind"]
    farm.plan["characters"]["elbow"]["train"] = {"passes": 3}
    os.utime(output / "elbow.blend")
    assert farm.run("elbow").returncode == 1 and farm.new_calls() == ["evaluate", "train"]
    assert "elbow.blend' has changed since" in (work / "bind/log").read_text(), "the work of others is not overwritten"


def test_a_training_with_a_goal_adds_poses(tmp_path):
    goal = {"goal-mm": 1e-6, "poses": 5}
    farm = Farm(tmp_path, one=character("one", objects=["elbow"], record={"poses": 40}, train=goal))
    run = farm.run("farm/one/train/done")
    assert run.returncode == 0, run.stdout
    report = json.loads((tmp_path / "out/one/models/report.json").read_text())
    index = json.loads((tmp_path / "farm/one/recording/recording.json").read_text())
    assert report["goal"]["verdict"] == "exhausted" and index["poses"] > 40
    assert farm.new_calls() == ["record", "train"]


SAVE_TWO_MESHES = """
import bpy, sys
bpy.ops.wm.open_mainfile(filepath=sys.argv[1])
copy = bpy.data.objects["elbow"].copy()
copy.data, copy.name = copy.data.copy(), "second"
bpy.context.scene.collection.objects.link(copy)
bpy.ops.wm.save_mainfile()
"""


@pytest.mark.parametrize("objects", [["second"], ["elbow", "second"]])
def test_the_objects_of_a_character_have_one_model(tmp_path, objects):
    farm = Farm(tmp_path, one=character("one", objects=objects, train={"goal-mm": 100}))
    subprocess.run([PYTHON, "-c", SAVE_TWO_MESHES, tmp_path / "elbow.blend"], check=True, **STREAMS)
    run = farm.run()
    assert run.returncode == 0, run.stdout
    assert farm.new_calls() == ["bind", "evaluate", "record", "train"]
    report = json.loads((tmp_path / "out/one/models/report.json").read_text())
    errors = json.loads((tmp_path / "farm/one/evaluate/errors.json").read_text())
    assert [mesh["name"] for mesh in report["meshes"]] == objects
    assert list(errors.get("objects", [])) == (objects if len(objects) > 1 else [])


@pytest.mark.parametrize(("status", "records"), [(75, 2), (2, 1)])
def test_only_a_fault_of_the_machine_is_tried_again(tmp_path, status, records):
    farm = Farm(tmp_path, elbow=character("elbow"))
    farm.status.write_text(str(status))
    run = farm.run("farm/elbow/record/done")
    assert (run.returncode == 0) == (status == 75), run.stdout
    assert farm.new_calls() == ["record"] * records
    assert farm.run("farm/elbow/record/done").returncode == 0, "the next run tries it again"


def test_a_failure_is_reported_and_the_other_characters_are_made(tmp_path):
    farm = Farm(tmp_path, bad=character("bad", record={"nothing": 3}), good=character("good"))
    run = farm.run("farm/bad/record/done", "farm/good/record/done")
    assert run.returncode == 1 and "unrecognized arguments: --nothing=3" in run.stdout
    assert farm.new_calls() == ["record", "record"] and (tmp_path / "farm/good/record/done").exists()


@pytest.mark.parametrize(
    ("characters", "message"),
    [
        ({}, "is wrong at characters: {} should be non-empty."),
        ({"a": {"rig": "elbow.blend"}}, "is wrong at characters.a: 'output' is a required property."),
        ({"a": character("a", poses=3)}, "is wrong at characters.a: Additional properties are not allowed ('poses'"),
        ({"a": character("a", record={"poses": {}})}, "is wrong at characters.a.record.poses: {} is not of type"),
        ({"a": character("c"), "b": character("c")}, "Two characters in 'characters.yaml' have the same output"),
        ({"a": {"rig": "no.blend", "output": "a"}}, "no.blend"),
    ],
)
def test_an_invalid_plan_is_refused(tmp_path, characters, message):
    run = Farm(tmp_path, **characters).run("--dry-run")
    assert run.returncode == 1 and message in run.stdout, run.stdout


def processes_of(token: str) -> list[int]:
    """Return the ids of all processes that have inherited a token in their environment."""
    process_ids = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if token.encode() in (folder / "environ").read_bytes():
                process_ids.append(int(folder.name))
    return process_ids


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="The test finds its processes in /proc.")
def test_nothing_is_lost_or_trained_twice_when_processes_are_killed(tmp_path):
    """Run on a cluster of two slots, and kill a random process every few seconds: workflow, jobs, steps and verbs."""
    count, kills = (int(os.environ.get(name, value)) for name, value in (("CHARACTERS", 2), ("KILLS", 12)))
    characters = {f"c{n}": character(f"c{n}", record={"poses": 600, "seed": n}) for n in range(count)}
    farm, rng, jobs = Farm(tmp_path, **characters), random.Random(0), tmp_path / "jobs"
    jobs.mkdir()
    cluster = [
        *("--executor", "cluster-generic", "--seconds-between-status-checks", "1", "--latency-wait", "5"),
        *("--cluster-generic-submit-cmd", shlex.join([*PROGRAMS, "submit", str(jobs)])),
        *("--cluster-generic-status-cmd", shlex.join([*PROGRAMS, "status"])),
    ]
    environment = {**os.environ, "FDDA_TEST": str(tmp_path)}
    is_finished = False
    while not is_finished:
        with open(tmp_path / "output", "ab") as output:
            run = subprocess.Popen(farm.command(*cluster), cwd=tmp_path, env=environment, stdout=output, stderr=output)
        while run.poll() is None:
            time.sleep(rng.uniform(1, 5))
            victims = processes_of(f"FDDA_TEST={tmp_path}") if kills else []
            # The workflow is spared most of the times, because it is the only process while it starts.
            if victims and ((victim := rng.choice(victims)) != run.pid or rng.random() < 0.2):
                kills -= 1
                with contextlib.suppress(ProcessLookupError):
                    os.kill(victim, signal.SIGKILL)
        is_finished = run.returncode == 0
    assert "train again" not in farm.calls.read_text(), "a finished model was trained again"
    for name in characters:
        assert (tmp_path / "out" / name / f"{name}.blend").is_file()
        assert (tmp_path / "farm" / name / "evaluate/errors.json").is_file()
        assert json.loads((tmp_path / "farm" / name / "recording/recording.json").read_text())["complete"] >= 600


def test_a_job_of_openjd_makes_a_character(tmp_path):
    farm = Farm(tmp_path, elbow=character("elbow"), other=character("other"))
    parameters = {"Character": "elbow", "Plan": farm.write_plan(), "Project": ROOT}
    command = [Path(sys.executable).with_name("openjd"), "run", ROOT / "farm/openjd.yaml"]
    command += [word for name, value in parameters.items() for word in ("-p", f"{name}={value}")]
    run = subprocess.run(command, cwd=tmp_path, check=False, **STREAMS)
    assert run.returncode == 0, run.stdout
    assert farm.new_calls() == ["bind", "evaluate", "record", "train"]


COMPILE_JOB = """
const [file, settings] = process.argv.slice(1), author = {
    Task: (name, type) => ({ name, type, addCommand(command) { this.command = command; } }),
    Command: (name, parameters) => ({ name, parameters }),
};
const source = require("fs").readFileSync(file, "utf8");
const [type, compile] = new Function("author", `${source}; return [JOB_TYPE, compileJob];`)(author);
const keys = type.settings.map((setting) => setting.key).sort();
compile({ settings: JSON.parse(settings), addTask: (task) => console.log(JSON.stringify([keys, task])) });
"""


@pytest.mark.skipif(not shutil.which("node"), reason="node is not installed")
def test_a_job_of_flamenco_makes_a_character(tmp_path):
    farm = Farm(tmp_path, elbow=character("elbow"), other=character("other"))
    settings = {"character": "elbow", "cores": 2, "plan": str(farm.write_plan()), "project": str(ROOT)}
    command = ["node", "-e", COMPILE_JOB, ROOT / "farm/fdda_character.js", json.dumps(settings)]
    keys, task = json.loads(subprocess.run(command, check=True, **STREAMS).stdout)
    assert keys == list(settings)
    command = [task["command"]["parameters"]["exe"], *task["command"]["parameters"]["args"], "--dry-run"]
    run = subprocess.run(command, cwd="/", check=False, **STREAMS)
    assert run.returncode == 0 and "character=elbow" in run.stdout and "character=other" not in run.stdout, run.stdout
