# SPDX-License-Identifier: GPL-3.0-or-later
"""Tests that no worker, verb or trainer of a farm is left after the farm was stopped or killed."""

import os
import secrets
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from farm.characters import Plan, read_plan
from farm.run import DONE
from farm.tasks import INFLUENCES, MERGE, RECORD, make_tasks

from .conftest import ELBOW, ONE_CHARACTER, ROOT, SMALL_SETTINGS, run_tasks

MAX_WAIT_SECONDS = 120
ENDLESS_TRAINING = "train = { epochs = 1000000, hidden = [8] }\nshards = 1\n"


@pytest.fixture(scope="module")
def training_plan(tmp_path_factory) -> Plan:
    """Return a plan whose next task is a training that does not end."""
    folder = tmp_path_factory.mktemp("farm")
    (folder / "elbow.blend").write_bytes(ELBOW.read_bytes())
    (folder / "characters.toml").write_text(SMALL_SETTINGS + ONE_CHARACTER + ENDLESS_TRAINING)
    plan = read_plan(folder / "characters.toml")
    assert {outcome.state for outcome in run_tasks(plan, (INFLUENCES, RECORD, MERGE)).values()} == {DONE}
    return plan


def find_processes(mark: str) -> dict[int, str]:
    """Return the command lines of running processes that have a mark in their environment, by process ID."""
    command_lines = {}
    for folder in Path("/proc").iterdir():
        try:
            if folder.name.isdecimal() and mark.encode() in (folder / "environ").read_bytes():
                command_lines[int(folder.name)] = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode()
        except OSError:
            continue
    return command_lines


def wait_until(condition) -> None:
    deadline = time.monotonic() + MAX_WAIT_SECONDS
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


CLUSTER_COMMAND = ("-m", "fdda_addon", "farm", "PLAN", "--workers", "1", "--dashboard-port", "0")
TASK_COMMAND = ("farm/launch.py", "PLAN", "--task", "elbow/train-0")


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="The test needs /proc to find processes.")
@pytest.mark.parametrize(
    ("arguments", "signal_number", "status"),
    [
        (CLUSTER_COMMAND, signal.SIGINT, 130),
        (CLUSTER_COMMAND, signal.SIGKILL, -signal.SIGKILL),
        (TASK_COMMAND, signal.SIGTERM, 143),
        (TASK_COMMAND, signal.SIGHUP, 129),
    ],
)
def test_all_processes_of_a_stopped_farm_end(training_plan, arguments, signal_number, status):
    mark = secrets.token_hex()
    command = [sys.executable, *(str(training_plan.path) if argument == "PLAN" else argument for argument in arguments)]
    with open(training_plan.path.with_name("printed"), "w+b") as printed:
        farm = subprocess.Popen(
            command,
            cwd=ROOT,
            env={**os.environ, "OF_THIS_TEST": mark},
            stdout=printed,
            stderr=printed,
            start_new_session=True,
        )
        try:
            wait_until(
                lambda: any("-m trainer" in line for line in find_processes(mark).values()) or farm.poll() is not None
            )
            assert farm.poll() is None, printed.seek(0) or printed.read().decode()
            # Signal the whole process group, as a terminal does; the watcher of the farm is not in it.
            os.killpg(farm.pid, signal_number)
            assert farm.wait(MAX_WAIT_SECONDS) == status
            remaining = find_processes(mark)
            was_killed = signal_number == signal.SIGKILL
            assert was_killed or not any("fdda_addon" in line or "trainer" in line for line in remaining.values()), (
                remaining
            )
            wait_until(lambda: not find_processes(mark))
        finally:
            for process_id in find_processes(mark):
                os.kill(process_id, signal.SIGKILL)
        printed.seek(0)
        text = printed.read().decode()
    assert not make_tasks(training_plan)["elbow/train-0"].manifest.exists()
    assert "Traceback" not in text and "Warning" not in text
    assert ("Interrupted; run the same command to go on.\n" in text) == (not was_killed)


def start_dask(mark: str, *arguments: str) -> subprocess.Popen:
    """Start a Dask scheduler or worker with a mark in its environment."""
    command = [sys.executable, "-m", "distributed.cli.dask_" + arguments[0], *arguments[1:], "--host", "127.0.0.1"]
    environment = {**os.environ, "OF_THIS_TEST": mark, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        command, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="The test needs /proc to find processes.")
def test_an_existing_cluster_ends_the_verbs_of_a_killed_farm(training_plan, tmp_path):
    mark = secrets.token_hex()
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    try:
        start_dask(mark, "scheduler", "--port", str(port), "--no-dashboard")
        worker = start_dask(mark, "worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard")
        command = [sys.executable, "-m", "farm", training_plan.path, "--scheduler", address]
        with open(tmp_path / "printed", "wb") as printed:
            farm = subprocess.Popen(command, cwd=ROOT, stdout=printed, stderr=printed)
        wait_until(
            lambda: any("-m trainer" in line for line in find_processes(mark).values()) or farm.poll() is not None
        )
        assert farm.poll() is None, (tmp_path / "printed").read_text()
        farm.kill()
        farm.wait()
        wait_until(lambda: not any("trainer" in line or "fdda_addon" in line for line in find_processes(mark).values()))
        assert worker.poll() is None, "the farm must not end workers that it did not start"
    finally:
        for process_id in find_processes(mark):
            os.kill(process_id, signal.SIGKILL)
