# SPDX-License-Identifier: GPL-3.0-or-later
"""What is suspicious about recordings of real rigs, and what is not."""

import json
import math
from pathlib import Path

import bpy
import pytest
from conftest import ELBOW, ELBOW_RIG, run

from fdda_addon.cli.files import save_copy
from fdda_addon.core.recording import read_recording
from fdda_addon.core.recording_check import check_recording
from fdda_addon.elbow import build_elbow


def record_elbow(folder: Path, turn: float, preserve_volume: bool, smooth: bool = True, poses: int = 200) -> Path:
    """Record an elbow whose lower bone turns about its length by up to `turn` degrees to each side."""
    build_elbow()
    limit = bpy.data.objects[ELBOW_RIG].pose.bones["lower"].constraints[0]
    limit.min_y, limit.max_y = math.radians(-turn), math.radians(turn)
    elbow = bpy.data.objects[ELBOW]
    elbow.modifiers["Armature"].use_deform_preserve_volume = preserve_volume
    if not smooth:
        elbow.modifiers.remove(elbow.modifiers["CorrectiveSmooth"])
    save_copy(folder / "elbow.blend")
    assert run("record", folder / "elbow.blend", folder / "recording", "--poses", poses) == 0
    return folder / "recording"


@pytest.mark.parametrize("smooth", [False, True])
def test_preserve_volume_flips_beyond_180_degrees(tmp_path, smooth, capsys):
    recording = record_elbow(tmp_path, 200, preserve_volume=True, smooth=smooth)
    capsys.readouterr()
    assert run("check-recording", recording, "--json", tmp_path / "checks.json") == 0
    (warning,) = json.loads((tmp_path / "checks.json").read_text(encoding="utf-8"))["warnings"]
    assert warning["name"] == "flips"
    assert warning["text"].startswith("Vertices of 'upper' jump up to ")
    assert "between poses that are alike in 'lower' (" in warning["text"]
    assert capsys.readouterr().out == f"Warning (flips): {warning['text']}\n"
    assert run("check-recording", recording, "--strict") == 1
    assert capsys.readouterr().err == f"Error: {warning['text'].removesuffix('.')} (flips).\n"


@pytest.mark.parametrize(
    ("turn", "preserve_volume", "smooth"),
    [(200, False, False), (170, False, True), (170, True, False), (170, True, True)],
)
def test_what_does_not_flip(tmp_path, turn, preserve_volume, smooth):
    recording = record_elbow(tmp_path, turn, preserve_volume, smooth)
    assert check_recording(read_recording(recording)) == []


def test_nothing_is_suspicious_about_the_arm(tmp_path, capsys):
    assert run("build-arm", tmp_path / "arm.blend") == 0
    assert run("record", tmp_path / "arm.blend", tmp_path / "recording", "--poses", 300) == 0
    capsys.readouterr()
    assert run("check-recording", tmp_path / "recording", "--strict") == 0
    assert capsys.readouterr().out == f"{tmp_path / 'recording'}: nothing suspicious was found\n"


def test_an_armature_beside_its_mesh(tmp_path):
    build_elbow()
    rig, elbow = bpy.data.objects[ELBOW_RIG], bpy.data.objects[ELBOW]
    elbow.parent = None
    rig.location.z, rig.rotation_euler.x = 0.5, math.radians(90)
    save_copy(tmp_path / "elbow.blend")
    assert run("record", tmp_path / "elbow.blend", tmp_path / "recording", "--poses", 40) == 0
    found = {w.name: w.text for w in check_recording(read_recording(tmp_path / "recording"))}
    assert found["axes"].startswith("2 of the 2 joints that skin the mesh lie outside its bounds, and joints lie ")
    assert "most of it along -Z" in found["axes"]
