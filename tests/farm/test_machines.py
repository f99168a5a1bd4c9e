# SPDX-License-Identifier: GPL-3.0-or-later
"""Tests of machines with full disks, which the farm waits for, and of Windows, which it refuses."""

import subprocess
import sys
from pathlib import Path

import pytest

from farm.__main__ import main
from farm.cluster import _outcome_of_future
from farm.run import AGAIN, FAILED, run_task
from farm.tasks import make_tasks
from fdda_addon.core.errors import TRY_AGAIN

from ..core.conftest import small_disk  # noqa: F401 - a fixture
from .conftest import ONE_CHARACTER, ROOT

DISK_FULL_MESSAGE = "No space left on device"


@pytest.fixture
def full_disk(small_disk: Path) -> Path:  # noqa: F811
    """Return a folder on a full disk."""
    with pytest.raises(OSError, match=DISK_FULL_MESSAGE), open(small_disk / "ballast", "wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    return small_disk


def test_a_full_disk_asks_to_try_again(write_plan, full_disk, tmp_path, capsys):
    """The test covers files that the farm itself writes; verbs report a full disk with their exit status."""
    plan = write_plan(ONE_CHARACTER, f'[farm]\nwork = "{full_disk}"\n')
    assert main([str(plan.path), "--task", "elbow/influences"]) == TRY_AGAIN
    assert DISK_FULL_MESSAGE in capsys.readouterr().err
    for option in (["--report-only", "--report"], ["--openjd"], ["--flamenco"]):
        assert main([str(plan.path), *option, str(full_disk / "all.html")]) == TRY_AGAIN
        assert DISK_FULL_MESSAGE in capsys.readouterr().err
    assert {path.name for path in full_disk.rglob("*") if path.is_file()} == {"ballast", "influences.lock"}


FULL_TEMPORARY_FOLDER_SCRIPT = """
import sys, tempfile
full_disk = sys.argv.pop(1)
tempfile._candidate_tempdir_list = lambda: [full_disk]
from farm.__main__ import run_program
run_program()
"""


def test_a_full_temporary_folder_asks_to_try_again(write_plan, full_disk):
    """Python falls back to another temporary folder when the first is full, so the test leaves it only the full one."""
    plan = write_plan()
    command = [
        sys.executable,
        "-c",
        FULL_TEMPORARY_FOLDER_SCRIPT,
        full_disk,
        plan.path,
        "--workers",
        "1",
        "--dashboard-port",
        "0",
    ]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == TRY_AGAIN, result.stderr
    assert "Error: No temporary file can be written" in result.stderr and "Traceback" not in result.stderr


class FailedFuture:
    """Stands in for a Dask future of a failed task."""

    status = "error"

    def __init__(self, error: BaseException):
        self._error = error

    def exception(self) -> BaseException:
        return self._error


@pytest.mark.parametrize(
    ("error", "state"),
    [
        (OSError(28, DISK_FULL_MESSAGE), AGAIN),
        (MemoryError(), AGAIN),
        (PermissionError(13, "no"), FAILED),
        (KeyError("a"), FAILED),
    ],
)
def test_only_machine_faults_are_tried_again(error, state):
    assert _outcome_of_future("elbow/bind", FailedFuture(error)).state == state


def test_a_folder_in_place_of_a_lock_file_is_not_tried_again(write_plan):
    plan = write_plan()
    tasks = make_tasks(plan)
    tasks["elbow/influences"].lock.mkdir(parents=True)
    outcome = run_task(plan.farm, tasks, "elbow/influences")
    assert outcome.state == FAILED and outcome.sentence.endswith("influences.lock': Is a directory.")


WINDOWS_SCRIPT = """
import argparse, contextlib, runpy, sys, pathlib, typing
import fdda_addon.core.output, fdda_addon.training.environment.folder, subprocess
sys.modules.update(fcntl=None, resource=None)
sys.platform = "win32"
sys.argv[1:] = ["characters.toml"]
runpy.run_module("farm", run_name="__main__", alter_sys=True)
"""


def test_windows_is_refused():
    """The farm must refuse before it imports modules that Windows lacks; the test simulates only the platform."""
    result = subprocess.run(
        [sys.executable, "-c", WINDOWS_SCRIPT], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert result.returncode == 1
    assert result.stderr.startswith("Error: The farm needs Linux or macOS") and result.stderr.count("\n") == 1
