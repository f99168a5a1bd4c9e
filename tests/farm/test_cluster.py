# SPDX-License-Identifier: GPL-3.0-or-later
"""Tests of the farm on a local Dask cluster with real workers and verbs, and of its command line."""

import json
import re
import subprocess
import sys

import psutil
import pytest

from farm.__main__ import main
from farm.fingerprints import check_outputs
from farm.tasks import make_tasks

from .conftest import ONE_CHARACTER, ROOT

THREE_CHARACTERS = (
    ONE_CHARACTER
    + 'actions = ["elbow_wave"]\ngoal_mm = 1000.0\nrounds = 1\n'
    + '[characters.broken]\nrig = "broken.blend"\noutput = "out/broken"\n'
    + '[characters.missing]\nrig = "missing.blend"\noutput = "out/missing"\n'
)


@pytest.fixture
def started_farm(write_plan, tmp_path):
    """Start a farm of one valid rig, one broken file and one missing file in its own process."""
    plan = write_plan(THREE_CHARACTERS)
    (tmp_path / "broken.blend").write_text("not a .blend file")
    command = [sys.executable, "-m", "fdda_addon", "farm", plan.path, "--workers", "2", "--dashboard-port", "0"]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    yield plan, process
    for child in psutil.Process(process.pid).children(recursive=True) if process.poll() is None else ():
        child.kill()
    process.kill()
    process.wait()


def listening_addresses(process: psutil.Process) -> set[str]:
    """Return the addresses that a process and its child processes listen on."""
    addresses = set()
    for each in [process, *process.children(recursive=True)]:
        try:
            addresses |= {c.laddr.ip for c in each.net_connections("inet") if c.status == psutil.CONN_LISTEN}
        except psutil.NoSuchProcess:
            continue
    return addresses


def test_a_farm_finishes_valid_characters_and_reports_failed_ones(started_farm, tmp_path):
    plan, process = started_farm
    addresses: set[str] = set()
    lines = []
    for line in process.stdout:
        lines.append(line)
        addresses |= listening_addresses(psutil.Process(process.pid))
    text = "".join(lines)
    assert process.wait() == 1, text
    assert addresses == {"127.0.0.1"}, "other machines must not reach the scheduler, because it runs code"
    for task in make_tasks(plan).values():
        if task.character == "elbow":
            check_outputs(task)
    assert re.search(r"elbow/refine-1 not needed: 99.9 % of the vertices are within", text)
    assert re.search(r"broken/influences failed: Blender cannot open '.*broken.blend'", text)
    assert "broken/record-1 blocked: 'broken/influences' is not done." in text
    assert "missing/bind failed: There is no file" in text
    report = json.loads((tmp_path / "report.json").read_text())["characters"]
    assert {name: character["state"] for name, character in report.items()} == {
        "elbow": "done",
        "broken": "failed",
        "missing": "failed",
    }
    assert [failure["task"] for failure in report["broken"]["failures"]] == ["broken/influences"]
    page = (tmp_path / "report.html").read_text()
    assert "Blender cannot open" in page and "1 of 3" in page and "http" not in page.replace('"http://www.w3.org', "")
    assert (tmp_path / "out/elbow/elbow.blend").is_file()


def test_a_farm_that_is_up_to_date_runs_no_task(write_plan, capsys, monkeypatch):
    plan = write_plan()
    monkeypatch.setattr("farm.fingerprints.is_up_to_date", lambda task, key: True)
    assert main([str(plan.path)]) == 0
    out = capsys.readouterr().out
    assert "to do" not in out and out.endswith("report.html: 1 character\n")


@pytest.mark.parametrize(
    ("options", "status", "message"),
    [
        (["--task", "elbow/bake"], 2, "The plan has no task 'elbow/bake'; --list names them."),
        (["--only", "hero"], 2, "The plan has no character 'hero'."),
        (["--workers", "none"], 2, "--workers is a list of numbers"),
        (["--scheduler", "tcp://127.0.0.1:9"], 75, "There is no scheduler at 'tcp://127.0.0.1:9'"),
        (["--list", "--dry-run"], 2, "not allowed with"),
    ],
)
def test_wrong_options_and_unreachable_schedulers_end_with_a_message(
    write_plan, capsys, monkeypatch, options, status, message
):
    monkeypatch.setattr("farm.cluster.CONNECT_SECONDS", 2)
    plan = write_plan()
    try:
        exit_status = main([str(plan.path), *options])
    except SystemExit as usage_error:
        exit_status = usage_error.code
    assert exit_status == status and message in capsys.readouterr().err


def test_the_list_shows_a_finished_task_as_up_to_date(write_plan, capsys):
    plan = write_plan()
    assert main([str(plan.path), "--task", "elbow/influences"]) == 0
    assert capsys.readouterr().out == "elbow/influences: done\n"
    assert main([str(plan.path), "--list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "elbow/influences: up to date" and lines[1] == "elbow/record-1: to do" and len(lines) == 7
