# SPDX-License-Identifier: GPL-3.0-or-later
"""The environment variables, the output and the end of child processes."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fdda_addon.core.files.child_process import OutputLines, child_options, end_process

PRINT_STATE = "import json, sys; print(json.dumps([sys.flags.optimize, sys.path, 'Jürgen']))"


def test_a_child_ignores_what_a_launcher_sets_for_another_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "launcher").mkdir()
    (tmp_path / "launcher" / "json.py").write_text("raise ImportError('of another Python')")
    variables = {"PYTHONHOME": "/nowhere", "PYTHONPATH": str(tmp_path / "launcher"), "PYTHONOPTIMIZE": "2"}
    variables |= {"PYTHONMALLOC": "no name", "PYTHONHASHSEED": "no number", "PYTHONPLATLIBDIR": "foo"}
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    command = [sys.executable, "-c", PRINT_STATE]
    result = subprocess.run(command, capture_output=True, check=False, **child_options(tmp_path / "own"))
    assert result.returncode == 0, result.stderr
    optimization, paths, text = json.loads(result.stdout)
    assert optimization == sys.flags.optimize and text == "Jürgen"
    assert str(tmp_path / "own") in paths and str(tmp_path / "launcher") not in paths


def test_a_child_imports_from_the_folders_of_pythonpath_that_this_python_uses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path / "used")])
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path / "other"), f"{tmp_path / 'used'}{os.sep}"]))
    monkeypatch.setenv("PYTHONNOUSERSITE", "1")
    environment = child_options(tmp_path)["env"]
    assert environment["PYTHONPATH"] == os.pathsep.join([str(tmp_path), f"{tmp_path / 'used'}{os.sep}"])
    assert environment["PYTHONNOUSERSITE"] == "1"


def test_lines_are_read_while_the_child_runs_and_it_is_killed():
    code = "import time; print('first', flush=True); time.sleep(60)"
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, **child_options())
    lines = OutputLines(process.stdout)
    assert lines.next(30) == "first\n" and lines.next() == "" and not lines.join(0.01)
    end_process(process, 0.01)
    assert process.returncode and lines.join(30) and lines.next() is None
    process.stdout.close()
