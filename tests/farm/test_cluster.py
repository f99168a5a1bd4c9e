# SPDX-License-Identifier: GPL-3.0-or-later
"""The farm on a local cluster of Dask: real workers, real verbs, one broken rig, and what listens where."""

import json
import re
import subprocess
import sys

import psutil
import pytest

from farm.__main__ import main
from farm.fingerprints import check_outputs
from farm.tasks import make_tasks

from .conftest import ONE, ROOT

TWO = (
    ONE
    + 'actions = ["elbow_wave"]\ngoal_mm = 1000.0\nrounds = 1\n'
    + '[characters.broken]\nrig = "broken.blend"\noutput = "out/broken"\n'
    + '[characters.gone]\nrig = "gone.blend"\noutput = "out/gone"\n'
)


@pytest.fixture
def farm_started(written, tmp_path):
    """A farm of one character that is good and two that are not, as a process of its own."""
    plan = written(TWO)
    (tmp_path / "broken.blend").write_text("no blend file")
    command = [sys.executable, "-m", "fdda_addon", "farm", plan.path, "--workers", "2", "--dashboard-port", "0"]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    yield plan, process
    for child in psutil.Process(process.pid).children(recursive=True) if process.poll() is None else ():
        child.kill()
    process.kill()
    process.wait()


def listening(process: psutil.Process) -> set[str]:
    """Addresses that a process and those that it started listen on."""
    found = set()
    for one in [process, *process.children(recursive=True)]:
        try:
            found |= {c.laddr.ip for c in one.net_connections("inet") if c.status == psutil.CONN_LISTEN}
        except psutil.NoSuchProcess:
            continue
    return found


def test_a_farm(farm_started, tmp_path):
    plan, process = farm_started
    addresses: set[str] = set()
    lines = []
    for line in process.stdout:
        lines.append(line)
        addresses |= listening(psutil.Process(process.pid))
    text = "".join(lines)
    assert process.wait() == 1, text
    assert addresses == {"127.0.0.1"}, "nobody else may send code to the scheduler"
    for task in make_tasks(plan).values():
        if task.character == "elbow":
            check_outputs(task)
    assert re.search(r"elbow/refine-1 not needed: 99.9 % of the vertices are within", text)
    assert re.search(r"broken/influences failed: Blender cannot open '.*broken.blend'", text)
    assert "broken/record-1 blocked: 'broken/influences' is not done." in text
    assert "gone/bind failed: There is no file" in text
    report = json.loads((tmp_path / "report.json").read_text())["characters"]
    assert {name: own["state"] for name, own in report.items()} == {
        "elbow": "done",
        "broken": "failed",
        "gone": "failed",
    }
    assert [failure["task"] for failure in report["broken"]["failures"]] == ["broken/influences"]
    page = (tmp_path / "report.html").read_text()
    assert "Blender cannot open" in page and "1 of 3" in page and "http" not in page.replace('"http://www.w3.org', "")
    assert (tmp_path / "out/elbow/elbow.blend").is_file()


def test_a_farm_that_is_up_to_date_starts_nothing(written, capsys, monkeypatch):
    plan = written()
    monkeypatch.setattr("farm.fingerprints.is_up_to_date", lambda task, key: True)
    assert main([str(plan.path)]) == 0
    out = capsys.readouterr().out
    assert "to do" not in out and out.endswith("report.html: 1 characters\n")


@pytest.mark.parametrize(
    ("options", "status", "words"),
    [
        (["--task", "elbow/bake"], 2, "The plan has no task 'elbow/bake'; --list names them."),
        (["--only", "hero"], 2, "The plan has no character 'hero'."),
        (["--workers", "none"], 2, "--workers is a list of numbers"),
        (["--scheduler", "tcp://127.0.0.1:9"], 75, "There is no scheduler at 'tcp://127.0.0.1:9'"),
        (["--list", "--dry-run"], 2, "not allowed with"),
    ],
)
def test_what_cannot_be_done(written, capsys, monkeypatch, options, status, words):
    monkeypatch.setattr("farm.cluster.CONNECT_SECONDS", 2)
    plan = written()
    try:
        found = main([str(plan.path), *options])
    except SystemExit as usage:
        found = usage.code
    captured = capsys.readouterr()
    assert found == status and words in captured.err


def test_one_task_and_the_list(written, capsys):
    plan = written()
    assert main([str(plan.path), "--task", "elbow/influences"]) == 0
    assert capsys.readouterr().out == "elbow/influences: done\n"
    assert main([str(plan.path), "--list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "elbow/influences: up to date" and lines[1] == "elbow/record-1: to do" and len(lines) == 7
