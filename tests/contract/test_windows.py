# SPDX-License-Identifier: GPL-3.0-or-later
"""The script that runs tests under Wine: its test files exist, and it counts the outcomes in pytest's report."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

from ..systems import WINDOWS

ROOT = Path(__file__).resolve().parents[2]
spec = importlib.util.spec_from_file_location("windows_run", ROOT / "tests/windows/run.py")
windows_run = importlib.util.module_from_spec(spec)
spec.loader.exec_module(windows_run)


@pytest.mark.parametrize("small", (True, False))
@pytest.mark.parametrize("line", windows_run.PYTHONS)
def test_files_that_the_script_runs_exist(line: str, small: bool):
    paths = [arguments[0] for _, arguments in windows_run.process_arguments(line, small)]
    assert len(paths) > 1 and [path for path in paths if not (ROOT / path).exists()] == []


def test_outcomes_in_the_report_are_counted(tmp_path: Path):
    test_file = tmp_path / "test_it.py"
    test_file.write_text(
        "import pytest\n"
        "@pytest.fixture\n"
        "def broken():\n    raise OSError\n"
        "@pytest.mark.parametrize('value', ('a - b', 'c'))\n"
        "def test_fails(value):\n    assert value == 'c'\n"
        "def test_errs(broken):\n    pass\n"
        "def test_skips():\n    pytest.skip('elsewhere')\n",
        encoding="utf-8",
    )
    report = tmp_path / "report.xml"
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"--junit-xml={report}", test_file]
    assert subprocess.run(command, cwd=tmp_path, capture_output=True, check=False).returncode == 1
    counts, failed = windows_run.read_outcomes(report)
    assert counts == {"passed": 1, "failed": 2, "skipped": 1}
    assert failed == ("test_it::test_fails[a - b]", "test_it::test_errs")


@pytest.mark.skipif(WINDOWS, reason="setup/windows/run is a POSIX shell script.")
def test_a_missing_windows_python_is_reported_with_its_setup(tmp_path: Path):
    command = [ROOT / "setup/windows/run", "3.13", "-c", "pass"]
    result = subprocess.run(command, env={**os.environ, "FDDA_WINDOWS": str(tmp_path)}, capture_output=True, text=True)
    assert result.returncode == 2 and result.stderr.count("\n") == 1
    assert os.getuid() or "create it: setup/windows/setup 3.13" in result.stderr
    assert subprocess.run([*command[:1], "3.12", "-c", "pass"], capture_output=True).returncode == 2
