# SPDX-License-Identifier: GPL-3.0-or-later
"""The trainer works with names that are not ASCII on an ASCII terminal, and with file names that are not UTF-8."""

import os
import subprocess
import sys
from dataclasses import replace

import pytest

from fdda_addon.core.mathematics.partition import make_partitions
from fdda_addon.core.rig import Joint

from .. import systems
from ..recordings import write_recording
from .chain import chain_angles, chain_info, chain_residuals, chain_rig, pose_chain
from .conftest import REPOSITORY

ASCII_ENVIRONMENT = {
    **os.environ,
    "PYTHONIOENCODING": "ascii",
    "LC_ALL": "C",
    "PYTHONUTF8": "0",
    "PYTHONCOERCECLOCALE": "0",
}


@pytest.fixture
def recording(tmp_path):
    """A recording of a chain with names in several scripts."""
    rig = chain_rig(2)
    mesh = replace(rig.meshes[0], name="Ärmel")
    rig = replace(rig, joints=(Joint("Wurzel ß", -1), Joint("前腕.L", 0)), meshes=(mesh,))
    angles = chain_angles(60, 2, 0)
    path = tmp_path / "Aufnahme äöü"
    arrays = pose_chain(rig, angles), chain_residuals(rig, angles)
    write_recording(path, rig, make_partitions(rig, {0: (1,), 1: (1,)}), chain_info(60), *arrays)
    return path


def run_module(*arguments) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", *arguments]
    return subprocess.run(command, cwd=REPOSITORY, env=ASCII_ENVIRONMENT, capture_output=True, check=False)


def test_an_ascii_terminal_and_a_model_name_that_is_not_utf_8(recording, tmp_path):
    name = "modèle.onnx".encode() if systems.WINDOWS else b"m\xff.onnx"  # On Windows every file name is text.
    model = os.fsencode(tmp_path) + b"/" + name
    process = run_module("trainer", recording, model, "--passes", "2", "--hidden", "8")
    assert process.returncode == 0, process.stderr
    assert rb"\u524d\u8155.L" in process.stdout and b"Wurzel \\xdf" in process.stdout
    assert os.path.exists(model) and (tmp_path / "report.html").exists()
    process = run_module("trainer.report", tmp_path / "réport.json")
    assert process.returncode == 1 and process.stderr.startswith(b"The report '") and b"Traceback" not in process.stderr
