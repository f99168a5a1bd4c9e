# SPDX-License-Identifier: GPL-3.0-or-later
"""A farm that is stopped, in whatever way, leaves none of its processes: workers, verbs, trainers, or its own."""

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

from .conftest import ELBOW, ONE, ROOT, SMALL, do_all

SECONDS = 120
LONG = "train = { epochs = 1000000, hidden = [8] }\nshards = 1\n"


@pytest.fixture(scope="module")
def in_training(tmp_path_factory) -> Plan:
    """A farm whose next task is a training that does not end."""
    folder = tmp_path_factory.mktemp("farm")
    (folder / "elbow.blend").write_bytes(ELBOW.read_bytes())
    (folder / "characters.toml").write_text(SMALL + ONE + LONG)
    plan = read_plan(folder / "characters.toml")
    assert {outcome.state for outcome in do_all(plan, (INFLUENCES, RECORD, MERGE)).values()} == {DONE}
    return plan


def processes(mark: str) -> dict[int, str]:
    """Processes with a mark in their environment that are not only waited for, and their command lines."""
    found = {}
    for folder in Path("/proc").iterdir():
        try:
            if folder.name.isdecimal() and mark.encode() in (folder / "environ").read_bytes():
                found[int(folder.name)] = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode()
        except OSError:
            continue
    return found


def wait_for(what) -> None:
    end = time.monotonic() + SECONDS
    while not what():
        assert time.monotonic() < end
        time.sleep(0.05)


CLUSTER = ("-m", "fdda_addon", "farm", "PLAN", "--workers", "1", "--dashboard-port", "0")
TASK = ("farm/launch.py", "PLAN", "--task", "elbow/train-0")


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="processes are found by /proc")
@pytest.mark.parametrize(
    ("arguments", "number", "status"),
    [
        (CLUSTER, signal.SIGINT, 130),
        (CLUSTER, signal.SIGKILL, -signal.SIGKILL),
        (TASK, signal.SIGTERM, 143),
        (TASK, signal.SIGHUP, 129),
    ],
)
def test_what_a_farm_has_started_ends_with_it(in_training, arguments, number, status):
    mark = secrets.token_hex()
    command = [sys.executable, *(str(in_training.path) if one == "PLAN" else one for one in arguments)]
    with open(in_training.path.with_name("printed"), "w+b") as printed:
        farm = subprocess.Popen(
            command,
            cwd=ROOT,
            env={**os.environ, "OF_THIS_TEST": mark},
            stdout=printed,
            stderr=printed,
            start_new_session=True,
        )
        try:
            wait_for(lambda: any("-m trainer" in line for line in processes(mark).values()) or farm.poll() is not None)
            assert farm.poll() is None, printed.seek(0) or printed.read().decode()
            # As a terminal does it, to the whole group; the watcher of the farm has left that.
            os.killpg(farm.pid, number)
            assert farm.wait(SECONDS) == status
            left = processes(mark)
            watched = number == signal.SIGKILL
            assert watched or not any("fdda_addon" in line or "trainer" in line for line in left.values()), left
            wait_for(lambda: not processes(mark))
        finally:
            for process in processes(mark):
                os.kill(process, signal.SIGKILL)
        printed.seek(0)
        text = printed.read().decode()
    assert not make_tasks(in_training)["elbow/train-0"].manifest.exists()
    assert "Traceback" not in text and "Warning" not in text
    assert ("Interrupted; run the same command to go on.\n" in text) == (number != signal.SIGKILL)


def dask(mark: str, *arguments: str) -> subprocess.Popen:
    """A program of Dask's with a mark in its environment."""
    command = [sys.executable, "-m", "distributed.cli.dask_" + arguments[0], *arguments[1:], "--host", "127.0.0.1"]
    environment = {**os.environ, "OF_THIS_TEST": mark, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        command, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="processes are found by /proc")
def test_a_cluster_that_was_there_ends_the_verbs_of_a_farm_that_is_gone(in_training, tmp_path):
    mark = secrets.token_hex()
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    try:
        dask(mark, "scheduler", "--port", str(port), "--no-dashboard")
        worker = dask(mark, "worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard")
        command = [sys.executable, "-m", "farm", in_training.path, "--scheduler", address]
        with open(tmp_path / "printed", "wb") as printed:
            farm = subprocess.Popen(command, cwd=ROOT, stdout=printed, stderr=printed)
        wait_for(lambda: any("-m trainer" in line for line in processes(mark).values()) or farm.poll() is not None)
        assert farm.poll() is None, (tmp_path / "printed").read_text()
        farm.kill()
        farm.wait()
        wait_for(lambda: not any("trainer" in line or "fdda_addon" in line for line in processes(mark).values()))
        assert worker.poll() is None, "the worker is not the farm's"
    finally:
        for process in processes(mark):
            os.kill(process, signal.SIGKILL)
