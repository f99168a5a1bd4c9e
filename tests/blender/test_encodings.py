# SPDX-License-Identifier: GPL-3.0-or-later
"""Names that are not ASCII, where the terminal shows nothing else."""

import json
import os
import subprocess
import sys
from pathlib import Path

import bpy
import pytest

from .refusals import save_elbow

pytestmark = pytest.mark.one_blender_version

ROOT = Path(__file__).resolve().parents[2]
ASCII = {**os.environ, "PYTHONIOENCODING": "ascii", "LC_ALL": "C"}


def rename(rig) -> None:
    rig.mesh_object.name = "Ärmel"
    rig.armature_object.data.bones["lower"].name = "前腕"


@pytest.fixture
def named(tmp_path):
    return save_elbow(tmp_path / "ellbögen.blend", rename)


def verb(*arguments, **environment) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "fdda_addon", *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, env=ASCII | environment, capture_output=True, check=False)


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


def test_names_where_python_takes_them_for_ascii(named, tmp_path):
    """UTF-8 mode off: what is typed reaches Python as bytes that it cannot read."""
    recording = tmp_path / "Aufnahme ß"
    arguments = ("record", named, recording, "--poses", 12, "--object", "Ärmel")
    done = verb(*arguments, PYTHONUTF8="0", PYTHONCOERCECLOCALE="0")
    assert done.returncode == 0 and b"Traceback" not in done.stderr, done.stderr
    assert json.loads((recording / "recording.json").read_text(encoding="utf-8"))["rig"]["object"] == "Ärmel"
