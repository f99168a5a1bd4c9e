# SPDX-License-Identifier: GPL-3.0-or-later
"""Names with characters outside ASCII, on terminals that support only ASCII."""

import json
import os
import subprocess
import sys
from pathlib import Path

import bpy
import pytest

from ..refusals import save_elbow

pytestmark = pytest.mark.one_blender_version

ROOT = Path(__file__).resolve().parents[3]
ASCII_ENVIRONMENT = {**os.environ, "PYTHONIOENCODING": "ascii", "LC_ALL": "C"}


def rename_with_unicode(rig) -> None:
    rig.mesh_object.name = "Ärmel"
    rig.armature_object.data.bones["lower"].name = "前腕"


@pytest.fixture
def unicode_rig(tmp_path):
    return save_elbow(tmp_path / "ellbögen.blend", rename_with_unicode)


def run_verb(*arguments, **environment) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "fdda_addon", *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, env=ASCII_ENVIRONMENT | environment, capture_output=True, check=False)


def test_verbs_on_an_ascii_terminal(unicode_rig, tmp_path):
    assert "Ärmel" in bpy.data.objects
    recording = tmp_path / "Aufnahme ß"
    for arguments in (("record", unicode_rig, recording, "--poses", 12), ("check-recording", recording)):
        result = run_verb(*arguments)
        assert result.returncode == 0, result.stderr
        assert b"Aufnahme \\xdf" in result.stdout and b"Traceback" not in result.stderr


def test_error_messages_on_an_ascii_terminal(unicode_rig):
    result = run_verb("record", unicode_rig, unicode_rig.parent / "r", "--object", "Handschuh ü")
    assert result.returncode == 1
    assert b"no mesh object 'Handschuh" in result.stderr and b"'\\xc4rmel'" in result.stderr
    assert result.stderr.count(b"\n") == 1


def test_arguments_without_utf_8_mode(unicode_rig, tmp_path):
    """Without UTF-8 mode, Python cannot decode the bytes of the arguments."""
    recording = tmp_path / "Aufnahme ß"
    arguments = ("record", unicode_rig, recording, "--poses", 12, "--object", "Ärmel")
    result = run_verb(*arguments, PYTHONUTF8="0", PYTHONCOERCECLOCALE="0")
    assert result.returncode == 0 and b"Traceback" not in result.stderr, result.stderr
    assert json.loads((recording / "recording.json").read_text(encoding="utf-8"))["meshes"][0]["name"] == "Ärmel"
