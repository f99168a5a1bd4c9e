# SPDX-License-Identifier: GPL-3.0-or-later
"""Names that are not ASCII, where the terminal shows nothing else."""

import os
import subprocess
import sys
from pathlib import Path

import bpy
import pytest

from .refusals import save_elbow

ROOT = Path(__file__).resolve().parents[2]
ASCII = {**os.environ, "PYTHONIOENCODING": "ascii", "LC_ALL": "C"}


def rename(rig) -> None:
    rig.mesh_object.name = "Ärmel"
    rig.armature_object.data.bones["lower"].name = "前腕"


@pytest.fixture
def named(tmp_path):
    return save_elbow(tmp_path / "ellbögen.blend", rename)


def verb(*arguments) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "fdda_addon", *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, env=ASCII, capture_output=True, check=False)


def test_verbs_on_a_terminal_that_knows_ascii_only(named, tmp_path):
    assert "Ärmel" in bpy.data.objects
    recording = tmp_path / "Aufnahme ß"
    for arguments in (("record", named, recording, "--poses", 12), ("check-recording", recording)):
        done = verb(*arguments)
        assert done.returncode == 0, done.stderr
        assert b"Aufnahme \\xdf" in done.stdout and b"Traceback" not in done.stderr


def test_refusals_on_a_terminal_that_knows_ascii_only(named):
    done = verb("record", named, named.parent / "r", "--object", "Handschuh ü")
    assert done.returncode == 1
    assert b"no mesh object 'Handschuh" in done.stderr and b"'\\xc4rmel'" in done.stderr
    assert done.stderr.count(b"\n") == 1
