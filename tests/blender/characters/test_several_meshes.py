# SPDX-License-Identifier: GPL-3.0-or-later
"""Two meshes on one armature with a recording each are trained, bound, evaluated and timed with one command each."""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import bpy
import pytest

import fdda_addon
from blend_fixtures.characters.meshes import body_and_sleeve
from fdda_addon.scene.blend_file import save_copy
from fdda_addon.timing.benchmark import RIG

from ..conftest import CommandOutput, assert_plays, output_of, pose, run
from ..refusals import Refusal, file_contents

BODY, SLEEVE = "elbow", "sleeve"
POSES = 60
ALONE = 4 * 3
"""Number of poses in which one input moves alone: four base poses, and from each, one for each of two joints."""


@dataclass(frozen=True)
class Files:
    """The files of both meshes: rig, folder of recordings, folder of models and bound file."""

    rig: Path
    recordings: Path
    models: Path
    bound: Path


@pytest.fixture(scope="module")
def commands() -> dict[str, CommandOutput]:
    """The output of `train`."""
    return {}


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory, commands: dict[str, CommandOutput]) -> Files:
    folder = tmp_path_factory.mktemp("several")
    made = Files(*(folder / name for name in ("rig.blend", "recordings", "models", "bound.blend")))
    fdda_addon.register()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    body_and_sleeve()
    save_copy(made.rig)
    for name in (BODY, SLEEVE):
        options = ("--object", name, "--poses", POSES, "--action", "elbow_wave")
        assert run("record", made.rig, made.recordings / name, *options) == 0
        (made.models / name).mkdir(parents=True)
        arguments = made.recordings / name, made.models / name / f"{name}.onnx", "--passes", 8, "--hidden", 16
        commands["train"] = output_of("train", *arguments)
    assert run("bind", made.rig, made.models, made.bound) == 0
    fdda_addon.unregister()
    return made


def test_train_prints_its_requirements_and_results(two, commands):
    (line,), err = commands["train"].out, commands["train"].err
    assert line.startswith(f"{two.models / SLEEVE / SLEEVE}.onnx: trained in ")
    takes = (
        f"{POSES + 30} poses of 300 vertices: less than 1 MB on the disk; residuals of the largest partition, 'upper'"
    )
    assert len([line for line in err if line.startswith(takes)]) == 1
    assert len([line for line in err if line.startswith("preparation: 2 of 2, ")]) == 1


def test_the_bound_file_plays_both(two):
    bpy.ops.wm.open_mainfile(filepath=str(two.bound))
    pose(angle=1.2)
    for name in (BODY, SLEEVE):
        mesh_object = bpy.data.objects[name]
        assert mesh_object.fdda.model == f"//models/{name}/{name}.onnx"
        assert_plays(mesh_object, two.models / name / f"{name}.onnx")


def test_models_are_copied_beside_a_file_elsewhere(two, tmp_path, capfd):
    assert run("bind", two.rig, two.models, tmp_path / "bound.blend") == 0
    assert sorted(file_contents(tmp_path)) == ["bound.blend", "elbow.onnx", "sleeve.onnx"]
    assert capfd.readouterr().out.count("a copy of") == 2
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "bound.blend"))
    pose(angle=0.7)
    for name in (BODY, SLEEVE):
        assert_plays(bpy.data.objects[name], two.models / name / f"{name}.onnx")


def test_evaluation_is_by_object_and_the_benchmark_by_character(two, tmp_path, capfd):
    out = tmp_path / "out.json"
    assert run("evaluate", two.rig, two.models, "--json", out, "--poses", 5) == 0
    objects = json.loads(out.read_text())["objects"]
    assert list(objects) == [BODY, SLEEVE] and [o["vertices"] for o in objects.values()] == [300, 300]
    assert "'sleeve':\nerror in mm" in capfd.readouterr().out
    assert run("evaluate", two.rig, two.models, "--json", out, "--poses", 5, "--object", SLEEVE) == 0
    assert json.loads(out.read_text()) == objects[SLEEVE]
    times = tmp_path / "times.json"
    # A benchmark is about the character: models of the arguments, or those that are bound.
    for arguments in ([two.rig, two.models], [two.bound]):
        assert run("benchmark", *arguments, "--json", times, "--frames", 2, "--overwrite") == 0
        report = json.loads(times.read_text())
        assert report["vertices"] == 600 and not report["is_estimate"]
        assert [(mesh["name"], mesh["has_model"]) for mesh in report["meshes"]] == [(BODY, True), (SLEEVE, True)]
        assert set(report["model_alone"]) == {BODY, SLEEVE}
        assert "sleeve (300 vertices): its model alone " in capfd.readouterr().out


def test_an_estimate_includes_meshes_without_an_armature_modifier_and_names_others(two, tmp_path, capfd):
    """A skirt with the name of a measured variant follows the body by Surface Deform, and a bow is not bound to it."""

    def add_followers() -> None:
        body = bpy.data.objects[BODY]
        for name in (RIG, "bow"):
            follower = bpy.data.objects.new(name, bpy.data.objects[SLEEVE].data.copy())
            bpy.context.scene.collection.objects.link(follower)
            modifier = follower.modifiers.new("Follow", "SURFACE_DEFORM")
            modifier.target = body
            if name == RIG:
                with bpy.context.temp_override(object=follower, active_object=follower):
                    assert bpy.ops.object.surfacedeform_bind(modifier="Follow") == {"FINISHED"}

    times = tmp_path / "times.json"
    clothed = changed(two, tmp_path / "clothed.blend", add_followers)
    assert run("benchmark", clothed, "--json", times, "--frames", 2) == 0
    report, output = json.loads(times.read_text()), capfd.readouterr().out
    assert {mesh["name"]: mesh["has_model"] for mesh in report["meshes"]} == {
        BODY: True,
        SLEEVE: True,
        RIG: True,
        "bow": False,
    }
    assert report["is_estimate"] and set(report["model_alone"]) == {BODY, SLEEVE, RIG}
    assert report["model_alone"][RIG] != report[RIG]["median"]
    assert "bow (300 vertices): Modifier 'Follow' of 'bow' is not bound, so it does nothing; bind it first" in output
    assert run("benchmark", clothed, "--profile", "--json", times, "--overwrite") == 0
    profile, output = json.loads(times.read_text())["profile"], capfd.readouterr().out
    assert profile["models"]["vertices"] == 1200 and {part["object"] for part in profile["parts"]} >= {BODY, SLEEVE}
    assert "3 of 4 meshes with models: " in output and f"Only {SLEEVE} with a model: " in output


def changed(two: Files, path: Path, change) -> Path:
    bpy.ops.wm.open_mainfile(filepath=str(two.rig))
    change()
    save_copy(path)
    return path


def test_a_mesh_that_fails_loses_no_times_of_others(two, tmp_path, capfd):
    def move_vertex() -> None:
        bpy.data.objects[SLEEVE].data.vertices[0].co.x += 0.1

    times = tmp_path / "times.json"
    moved = changed(two, tmp_path / "moved.blend", move_vertex)
    assert run("benchmark", moved, two.models, "--json", times, "--frames", 2) == 1
    output = capfd.readouterr()
    assert "was trained for another rig" in output.err and "elbow (300 vertices)" in output.out
    meshes = {mesh["name"]: mesh for mesh in json.loads(times.read_text())["meshes"]}
    assert meshes[BODY]["has_model"] and "was trained for another rig" in meshes[SLEEVE]["reason"]


def test_a_model_of_a_missing_object_is_refused(two, tmp_path, capfd):
    rig = changed(two, tmp_path / "rig.blend", lambda: bpy.data.objects.remove(bpy.data.objects[SLEEVE]))
    sentence = Refusal(tmp_path, capfd)("bind", rig, two.models, tmp_path / "bound.blend")
    assert f"'{two.models / SLEEVE / SLEEVE}.onnx' is a model of the object 'sleeve', and '{rig}' has no" in sentence


def test_unsuitable_folders_are_refused(two, tmp_path, capfd):
    refuse = Refusal(tmp_path, capfd)
    (tmp_path / "empty").mkdir()
    assert "contains no model" in refuse("bind", two.rig, tmp_path / "empty", tmp_path / "b.blend")
    sentence = refuse("evaluate", two.rig, two.models, "--json", tmp_path / "e.json", "--object", "hat")
    assert f"'{two.models}' has no model of 'hat'; it has those of 'elbow', 'sleeve'." in sentence
    shutil.copytree(two.models, tmp_path / "models")
    shutil.copy(two.models / BODY / "elbow.onnx", tmp_path / "models" / "other.onnx")
    assert "are both models of 'elbow'; remove one" in refuse(
        "bind", two.rig, tmp_path / "models", tmp_path / "b.blend"
    )


@pytest.mark.parametrize(
    ("verb", "options", "text"),
    [
        ("record", ("--all", "--object", BODY), "give one of them"),
        ("evaluate", ("--json", "e.json", "--action", "a", "--video", "v.mp4"), "--video draws one mesh"),
    ],
)
def test_options_for_one_mesh_are_refused_for_several(two, tmp_path, monkeypatch, capfd, verb, options, text):
    monkeypatch.chdir(tmp_path)
    assert run(verb, two.rig, two.recordings if verb == "record" else two.models, *options) == 2
    assert text in capfd.readouterr().err
    assert file_contents(tmp_path) == {}
