# SPDX-License-Identifier: GPL-3.0-or-later
"""What a machine lacks: room on its disks, which is waited for, and what Windows does not have."""

import subprocess
import sys
from pathlib import Path

import pytest

from farm.__main__ import main
from farm.cluster import _outcome
from farm.run import AGAIN, FAILED, run_task
from farm.tasks import make_tasks
from fdda_addon.core.errors import TRY_AGAIN

from ..core.conftest import small_disk  # noqa: F401 - a fixture
from .conftest import ONE, ROOT

FULL = "No space left on device"


@pytest.fixture
def full_disk(small_disk: Path) -> Path:  # noqa: F811
    """A folder on a disk that is full."""
    with pytest.raises(OSError, match=FULL), open(small_disk / "ballast", "wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    return small_disk


def test_a_full_disk_is_waited_for(written, full_disk, tmp_path, capsys):
    """Where the farm itself writes: what verbs say is in their exit status."""
    plan = written(ONE, f'[farm]\nwork = "{full_disk}"\n')
    assert main([str(plan.path), "--task", "elbow/influences"]) == TRY_AGAIN
    assert FULL in capsys.readouterr().err
    for option in (["--report-only", "--report"], ["--openjd"], ["--flamenco"]):
        assert main([str(plan.path), *option, str(full_disk / "all.html")]) == TRY_AGAIN
        assert FULL in capsys.readouterr().err
    assert {path.name for path in full_disk.rglob("*") if path.is_file()} == {"ballast", "influences.lock"}


IN_FULL = """
import sys, tempfile
full = sys.argv.pop(1)
tempfile._candidate_tempdir_list = lambda: [full]
from farm.__main__ import program
program()
"""


def test_a_full_temporary_folder_is_waited_for(written, full_disk):
    """Python looks for another one, so that the full one is all that it finds here."""
    plan = written()
    command = [sys.executable, "-c", IN_FULL, full_disk, plan.path, "--workers", "1", "--dashboard-port", "0"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == TRY_AGAIN, result.stderr
    assert "Error: No temporary file can be written" in result.stderr and "Traceback" not in result.stderr


class Future:
    """As Dask has it of a task that has failed for good."""

    status = "error"

    def __init__(self, error: BaseException):
        self._error = error

    def exception(self) -> BaseException:
        return self._error


@pytest.mark.parametrize(
    ("error", "state"),
    [(OSError(28, FULL), AGAIN), (MemoryError(), AGAIN), (PermissionError(13, "no"), FAILED), (KeyError("a"), FAILED)],
)
def test_whose_fault_a_failure_is(error, state):
    assert _outcome("elbow/bind", Future(error)).state == state


def test_what_is_in_the_place_of_a_file_is_not_waited_for(written):
    plan = written()
    tasks = make_tasks(plan)
    tasks["elbow/influences"].lock.mkdir(parents=True)
    outcome = run_task(plan.farm, tasks, "elbow/influences")
    assert outcome.state == FAILED and outcome.sentence.endswith("influences.lock': Is a directory.")


WINDOWS = """
import argparse, contextlib, runpy, sys, pathlib, typing
import fdda_addon.core.output, fdda_addon.training.environment.folder, subprocess
sys.modules.update(fcntl=None, resource=None)
sys.platform = "win32"
sys.argv[1:] = ["characters.toml"]
runpy.run_module("farm", run_name="__main__", alter_sys=True)
"""


def test_windows_is_refused():
    """Before anything is imported that Windows lacks; the platform alone is made up."""
    result = subprocess.run([sys.executable, "-c", WINDOWS], cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert result.stderr.startswith("Error: The farm needs Linux or macOS") and result.stderr.count("\n") == 1
