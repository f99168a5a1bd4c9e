# SPDX-License-Identifier: GPL-3.0-or-later
"""A lock on a file excludes other processes, and ends with the last process that has the file open."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from fdda_addon.core.files.file_lock import NoLocksError, has_ended, try_lock

from ... import systems

ROOT = Path(__file__).resolve().parents[3]
HOLD_LOCK = """
import sys
from fdda_addon.core.files.file_lock import try_lock
file = open(sys.argv[1], "r+b")
print(try_lock(file.fileno(), sys.argv[2] == "shared"), flush=True)
sys.stdin.read()
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Return the path of a file with a few bytes."""
    path = tmp_path / "file"
    path.write_bytes(b"content")
    return path


@pytest.fixture
def hold_lock(path: Path):
    """Return a function that starts a process with an "exclusive" or "shared" lock on the file."""
    processes = []

    def start(kind: str) -> subprocess.Popen:
        process = subprocess.Popen(
            [sys.executable, "-c", HOLD_LOCK, str(path), kind],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        processes.append(process)
        assert process.stdout.readline() == "True\n"
        return process

    yield start
    for process in processes:
        process.kill()
        process.wait()
        process.stdin.close()
        process.stdout.close()


def test_a_lock_excludes_others_until_its_process_is_killed(path, hold_lock):
    holder = hold_lock("exclusive")
    with path.open("r+b") as file:
        assert not try_lock(file.fileno()) and not try_lock(file.fileno(), is_shared=True)
        assert file.read() == b"content", "the file can be read while it is locked"
        holder.kill()
        holder.wait()
        assert try_lock(file.fileno()) and file.tell() == 7


@systems.forks
def test_shared_locks_exclude_only_exclusive_locks(path, hold_lock):
    hold_lock("shared")
    with path.open("rb") as file:
        assert try_lock(file.fileno(), is_shared=True)
    with path.open("r+b") as file:
        assert not try_lock(file.fileno())


@pytest.mark.parametrize("number", systems.NO_LOCKS_ERRNOS)
def test_a_drive_without_locks_is_told_from_a_held_lock(path, monkeypatch, number):
    systems.refuse_locks(monkeypatch, number)
    with path.open("r+b") as file, pytest.raises(NoLocksError, match="its drive cannot lock files") as error:
        try_lock(file.fileno())
    assert error.value.errno == number


@systems.forks
def test_only_processes_of_this_machine_have_ended_for_certain():
    host = socket.gethostname()
    with subprocess.Popen(["cat"], stdin=subprocess.PIPE) as process:
        assert not has_ended(process.pid, host) and not has_ended(os.getppid(), host)
    assert has_ended(process.pid, host) and has_ended(10**30, host) and not has_ended(process.pid, "render-07")


@systems.forks
def test_a_child_process_inherits_the_lock(path):
    with path.open("r+b") as file:
        assert try_lock(file.fileno())
        child = subprocess.Popen(["cat"], stdin=subprocess.PIPE, pass_fds=[file.fileno()])
    with path.open("r+b") as file:
        assert not try_lock(file.fileno())
        child.communicate()
        assert try_lock(file.fileno())
