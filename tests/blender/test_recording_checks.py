# SPDX-License-Identifier: GPL-3.0-or-later
"""Which properties of recorded rigs `check-recording` reports as suspicious."""

import json
import math
from pathlib import Path

import bpy
import pytest

from blend_fixtures.characters.bones import NewBone, add_bones
from blend_fixtures.elbow import build_elbow
from fdda_addon.core.checks.recording import check_recording
from fdda_addon.core.formats.model import read_model_info
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.skinned import skin_recording
from fdda_addon.scene.blend_file import save_copy

from .conftest import ELBOW, ELBOW_RIG, run, train


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
    assert "between similar poses, 'lower' on the two sides of 180 degrees (" in warning["text"]
    assert capsys.readouterr().out == f"Warning (flips): {warning['text']}\n"
    assert run("check-recording", recording, "--strict") == 1
    assert capsys.readouterr().err == f"Error: {warning['text'].removesuffix('.')} (flips).\n"


@pytest.mark.parametrize(
    ("turn", "preserve_volume", "smooth"),
    [(200, False, False), (170, False, True), (170, True, False), (170, True, True)],
)
def test_what_does_not_flip(tmp_path, turn, preserve_volume, smooth):
    recording = record_elbow(tmp_path, turn, preserve_volume, smooth)
    assert check_recording(skin_recording(read_recording(recording))) == []


def test_nothing_is_suspicious_about_the_arm(tmp_path, capsys):
    assert run("build-arm", tmp_path / "arm.blend") == 0
    assert run("record", tmp_path / "arm.blend", tmp_path / "recording", "--poses", 300) == 0
    capsys.readouterr()
    assert run("check-recording", tmp_path / "recording", "--strict") == 0
    assert capsys.readouterr().out == f"{tmp_path / 'recording'}: no problems were found\n"


def test_an_armature_beside_its_mesh(tmp_path):
    build_elbow()
    rig, elbow = bpy.data.objects[ELBOW_RIG], bpy.data.objects[ELBOW]
    elbow.parent = None
    rig.location.z, rig.rotation_euler.x = 0.5, math.radians(90)
    save_copy(tmp_path / "elbow.blend")
    assert run("record", tmp_path / "elbow.blend", tmp_path / "recording", "--poses", 40) == 0
    found = {w.name: w.text for w in check_recording(skin_recording(read_recording(tmp_path / "recording")))}
    assert found["axes"].startswith("2 of the 2 joints that skin the mesh lie outside its bounds, and joints lie ")
    assert "most of it along -Z" in found["axes"]


class TestSmallPartitions:
    """The elbow with a bone `tip` that has the last ring, 12 vertices, and `nail` with 3 of them."""

    @pytest.fixture
    def rig(self, tmp_path: Path) -> Path:
        elbow, rig = build_elbow()
        add_bones(
            rig, *(NewBone(n, (0.48, 0, 0), (0.5, 0, 0), parent) for n, parent in (("tip", "lower"), ("nail", "tip")))
        )
        last = [v.index for v in elbow.data.vertices if v.co.x > 0.499]
        assert len(last) == 12
        for name, indices in (("tip", last[3:]), ("nail", last[:3])):
            elbow.vertex_groups["lower"].remove(indices)
            elbow.vertex_groups.new(name=name).add(indices, 1.0, "REPLACE")
        save_copy(tmp_path / "tip.blend")
        return tmp_path / "tip.blend"

    def test_a_training_merges_and_names_them(self, rig, tmp_path, capfd):
        assert run("record", rig, tmp_path / "r", "--poses", 30) == 0
        for options, line, sizes in (
            ((), "1 partition of fewer than 8 vertices is merged: 'nail' into 'tip'.", [156, 132, 12]),
            ((13,), "2 partitions of fewer than 13 vertices are merged: 'tip' into 'lower', 'nail'", [156, 144]),
            ((0,), "", [156, 132, 9, 3]),
        ):
            options = [argument for value in options for argument in ("--min-vertices-per-part", value)]
            capfd.readouterr()
            assert run("train", tmp_path / "r", tmp_path / "m.onnx", "--passes", 1, *options) == 0
            printed = "".join(capfd.readouterr())
            assert line in printed and ("merged" in printed) == bool(line)
            assert [p.vertices for p in read_model_info(tmp_path / "m.onnx").partitions] == sizes

    def test_the_model_and_its_evaluation_have_them(self, rig, tmp_path, capsys):
        assert run("record", rig, tmp_path / "r", "--poses", 60) == 0
        train(tmp_path / "r", tmp_path / "m.onnx", "--passes", 20)
        assert run("evaluate", rig, tmp_path / "m.onnx", "--json", tmp_path / "e.json", "--poses", 20) == 0
        evaluation = json.loads((tmp_path / "e.json").read_text(encoding="utf-8"))
        sizes = {p["joint"]: p["vertices"] for p in evaluation["partitions"]}
        report = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
        assert sizes == {p["joint"]: p["vertices"] for p in report["partitions"]}
        assert (sizes["tip"], sum(sizes.values())) == (12, 300)
        assert {p["joint"]: p.get("merged", []) for p in report["partitions"]} == {
            **{"upper": [], "lower": []},
            "tip": ["nail"],
        }
        assert evaluation["fdda"]["mean"] < 0.5 * evaluation["linear"]["mean"]
