# SPDX-License-Identifier: GPL-3.0-or-later
"""Two meshes on one armature are recorded, trained, bound, evaluated and timed with one command each."""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
import pytest

import fdda_addon
from blend_fixtures.characters.base import cage, link, skin
from blend_fixtures.characters.meshes import body_and_sleeve
from fdda_addon.cli.pose_notes import REMIX_HINT
from fdda_addon.core.errors import TRY_AGAIN
from fdda_addon.core.formats.model import read_model_info
from fdda_addon.core.recording.index import read_index
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.recording.run import record_meshes
from fdda_addon.scene.blend_file import save_copy
from fdda_addon.scene.scene_rig import find_rigs

from ..command_output import CommandOutput, output_of
from ..conftest import assert_plays, pose, run
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
    """The output of `record` and `train`."""
    return {}


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory, commands: dict[str, CommandOutput]) -> Files:
    folder = tmp_path_factory.mktemp("several")
    made = Files(*(folder / name for name in ("rig.blend", "recordings", "models", "bound.blend")))
    fdda_addon.register()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    body_and_sleeve()
    save_copy(made.rig)
    commands["record"] = output_of(
        "record", made.rig, made.recordings, "--all", "--poses", POSES, "--action", "elbow_wave"
    )
    commands["train"] = output_of("train", made.recordings, made.models, "--epochs", 8, "--hidden", 16)
    assert run("bind", made.rig, made.models, made.bound) == 0
    fdda_addon.unregister()
    return made


def test_the_meshes_share_their_poses(two):
    body, sleeve = (read_recording(two.recordings / name) for name in (BODY, SLEEVE))
    assert body.rig.joint_names == sleeve.rig.joint_names
    assert len(body.pose_matrices) == POSES + 30 + ALONE and (body.pose_matrices == sleeve.pose_matrices).all()
    assert body.info.sampling == sleeve.info.sampling
    assert [recording.rig.meshes[0].name for recording in (body, sleeve)] == [BODY, SLEEVE]


def test_each_mesh_is_recorded_as_by_itself(two, tmp_path):
    for name in (BODY, SLEEVE):
        options = ("--object", name, "--poses", POSES, "--action", "elbow_wave")
        assert run("record", two.rig, tmp_path / name, *options) == 0
    assert file_contents(tmp_path) == file_contents(two.recordings)


def test_a_pose_is_evaluated_once(two, tmp_path):
    bpy.ops.wm.open_mainfile(filepath=str(two.rig))
    evaluations = []

    def count(*_: object) -> None:
        evaluations.append(1)

    bpy.app.handlers.depsgraph_update_post.append(count)
    seen = []
    rigs = [(rig, tmp_path / rig.mesh_object.name) for rig in find_rigs()]
    steps = record_meshes(rigs, RecordingSettings(poses=20, influence_poses=1))
    for step in steps:
        if step.stage == "poses":
            seen.append(len(evaluations))
    # One base pose for each mesh, and one pose for each of the two joints.
    assert len(rigs) == 2 and np.diff(seen).tolist() == [1] * (20 + 2 * 3)


def test_a_subdivided_body_is_recorded_after_the_sleeve_that_reads_it(two, tmp_path):
    bpy.ops.wm.open_mainfile(filepath=str(two.rig))
    bpy.data.objects[BODY].modifiers.new("Subdivision", "SUBSURF").levels = 1
    save_copy(tmp_path / "rig.blend")
    options = ("--poses", 8, "--object", SLEEVE)
    assert run("record", tmp_path / "rig.blend", tmp_path / "both", *options, "--object", BODY) == 0
    assert run("record", tmp_path / "rig.blend", tmp_path / "alone", *options) == 0
    body, sleeve, alone = (read_recording(tmp_path / name) for name in ("both/elbow", "both/sleeve", "alone"))
    assert (body.pose_matrices == sleeve.pose_matrices).all()
    assert (sleeve.positions == alone.positions).all()


def test_each_mesh_has_its_own_shape_keys_as_controls(two, tmp_path):
    """`shape_keys/…` names a separate property of each mesh. A key of one mesh is no input of the other mesh."""

    def add_keys() -> None:
        for name, keys in ((BODY, ("Basis", "puff")), (SLEEVE, ("Basis", "puff", "fold"))):
            for key in keys:
                bpy.data.objects[name].shape_key_add(name=key, from_mix=False)
                for point in bpy.data.objects[name].data.shape_keys.key_blocks[key].data:
                    point.co *= 1.0 if key == "Basis" else 1.1

    rig = changed(two, tmp_path / "rig.blend", add_keys)
    options = ("--all", "--poses", 12, "--control", "fold=0:0.5")
    assert run("record", rig, tmp_path / "r", *options) == 0
    body, sleeve = (read_recording(tmp_path / "r" / name) for name in (BODY, SLEEVE))
    assert (body.pose_matrices[:12] == sleeve.pose_matrices[:12]).all()
    puff, fold = (f'shape_keys/key_blocks["{key}"].value' for key in ("puff", "fold"))
    assert [control.name for control in body.rig.controls] == [puff]
    assert [control.name for control in sleeve.rig.controls] == [puff, fold]
    for recording in (body, sleeve):
        sampled = [channel.name for channel in recording.info.sampling.channels if channel.kind == "control"]
        assert sampled == [control.name for control in recording.rig.controls]
        assert np.ptp(recording.controls, axis=0).min() > 0.1
    assert np.abs(body.controls[:12, 0] - sleeve.controls[:12, 0]).max() > 0.1


def test_an_interrupted_recording_goes_on_where_each_mesh_stopped(two, tmp_path):
    bpy.ops.wm.open_mainfile(filepath=str(two.rig))
    settings = RecordingSettings(poses=POSES, actions=("elbow_wave",))
    rigs = [(rig, tmp_path / "r" / rig.mesh_object.name) for rig in find_rigs()]
    steps = record_meshes(rigs, settings)
    for step in steps:
        if step.stage == "poses" and step.done == 7:
            break
    steps.close()
    assert [read_index(path)["complete"] for _, path in rigs] == [7, 7]
    # The recording of the body is complete, and the recording of the sleeve is not.
    shutil.rmtree(tmp_path / "r" / BODY)
    shutil.copytree(two.recordings / BODY, tmp_path / "r" / BODY)
    options = ("--all", "--poses", POSES, "--action", "elbow_wave", "--resume")
    assert run("record", two.rig, tmp_path / "r", *options) == 0
    assert file_contents(tmp_path / "r") == file_contents(two.recordings)


def test_each_mesh_has_a_model_and_a_report_of_its_own(two):
    for name in (BODY, SLEEVE):
        assert read_model_info(two.models / name / f"{name}.onnx").meshes[0].name == name
        assert {path.name for path in (two.models / name).iterdir()} == {
            *(f"{name}.onnx", f"{name}.checkpoint.npz", "report.json", "report.html")
        }


def test_record_prints_its_requirements_and_results(two, commands):
    out, err = commands["record"].out, commands["record"].err
    poses = f"{POSES + 30 + ALONE} poses"
    assert out[0] == REMIX_HINT
    assert out[1].startswith(f"{POSES + 30 + 2 * ALONE} poses of 600 vertices: less than 1 MB on the disk, about ")
    assert [line.partition(" in ")[0] for line in out[2:]] == [f"{two.recordings / n}: {poses}" for n in (BODY, SLEEVE)]
    assert {line.partition(":")[0] for line in err} == {"poses"}


def test_train_prints_its_requirements_and_results(two, commands):
    out, err = commands["train"].out, commands["train"].err
    starts = [*(f"{two.models / n / n}.onnx: trained in " for n in (BODY, SLEEVE)), f"{two.models}: 2 models in "]
    assert [line.startswith(start) for line, start in zip(out, starts, strict=True)] == [True] * 3
    takes = (
        f"{POSES + 30} poses of 300 vertices: less than 1 MB on the disk; residuals of the largest partition, 'upper'"
    )
    assert len([line for line in err if line.startswith(takes)]) == 2
    assert len([line for line in err if line.startswith("preparation: 2 of 2, ")]) == 2


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
    """A skirt follows the body by Surface Deform, and a bow is not bound to it."""

    def add_followers() -> None:
        body = bpy.data.objects[BODY]
        for name in ("skirt", "bow"):
            follower = bpy.data.objects.new(name, bpy.data.objects[SLEEVE].data.copy())
            bpy.context.scene.collection.objects.link(follower)
            modifier = follower.modifiers.new("Follow", "SURFACE_DEFORM")
            modifier.target = body
            if name == "skirt":
                with bpy.context.temp_override(object=follower, active_object=follower):
                    assert bpy.ops.object.surfacedeform_bind(modifier="Follow") == {"FINISHED"}

    times = tmp_path / "times.json"
    clothed = changed(two, tmp_path / "clothed.blend", add_followers)
    assert run("benchmark", clothed, "--json", times, "--frames", 2) == 0
    report, output = json.loads(times.read_text()), capfd.readouterr().out
    assert {mesh["name"]: mesh["has_model"] for mesh in report["meshes"]} == {
        BODY: True,
        SLEEVE: True,
        "skirt": True,
        "bow": False,
    }
    assert report["is_estimate"] and set(report["model_alone"]) == {BODY, SLEEVE, "skirt"}
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


def test_two_names_with_the_same_folder_are_refused(two, tmp_path, capfd):
    def rename() -> None:
        bpy.data.objects[BODY].name, bpy.data.objects[SLEEVE].name = "left arm", "Left_arm"

    rig = changed(two, tmp_path / "rig.blend", rename)
    sentence = Refusal(tmp_path, capfd)("record", rig, tmp_path / "r", "--all")
    assert f"'left arm' and 'Left_arm' would both be recorded into '{tmp_path / 'r' / 'Left_arm'}'; rename" in sentence


def test_meshes_of_two_armatures_are_refused(two, tmp_path, capfd):
    def add_hat() -> None:
        other = link(bpy.data.objects["elbow_rig"].copy())
        other.name = "hat_rig"
        skin(cage("hat", 1.3), other)

    rig = changed(two, tmp_path / "rig.blend", add_hat)
    sentence = Refusal(tmp_path, capfd)("record", rig, tmp_path / "r", "--all", "--poses", 3)
    assert "'elbow' follows the armature 'elbow_rig' and 'hat' follows 'hat_rig'; record the meshes of each" in sentence


def test_a_model_of_a_missing_object_is_refused(two, tmp_path, capfd):
    rig = changed(two, tmp_path / "rig.blend", lambda: bpy.data.objects.remove(bpy.data.objects[SLEEVE]))
    sentence = Refusal(tmp_path, capfd)("bind", rig, two.models, tmp_path / "bound.blend")
    assert f"'{two.models / SLEEVE / SLEEVE}.onnx' is a model of the object 'sleeve', and '{rig}' has no" in sentence


def test_unsuitable_folders_are_refused(two, tmp_path, capfd):
    refuse = Refusal(tmp_path, capfd)
    (tmp_path / "empty").mkdir()
    assert "contains no model" in refuse("bind", two.rig, tmp_path / "empty", tmp_path / "b.blend")
    assert "give a folder for the models" in refuse("train", two.recordings, tmp_path / "m.onnx")
    sentence = refuse("evaluate", two.rig, two.models, "--json", tmp_path / "e.json", "--object", "hat")
    assert f"'{two.models}' has no model of 'hat'; it has those of 'elbow', 'sleeve'." in sentence
    shutil.copytree(two.models, tmp_path / "models")
    shutil.copy(two.models / BODY / "elbow.onnx", tmp_path / "models" / "other.onnx")
    assert "are both models of 'elbow'; remove one" in refuse(
        "bind", two.rig, tmp_path / "models", tmp_path / "b.blend"
    )


def test_an_incomplete_recording_of_several_is_refused_before_the_first_training(two, tmp_path, capfd):
    shutil.copytree(two.recordings, tmp_path / "r")
    index = json.loads((tmp_path / "r" / SLEEVE / "recording.json").read_text())
    index["complete"] -= 1
    (tmp_path / "r" / SLEEVE / "recording.json").write_text(json.dumps(index))
    sentence = Refusal(tmp_path, capfd)("train", tmp_path / "r", tmp_path / "m")
    assert f"'{tmp_path / 'r' / SLEEVE}' is incomplete: {POSES + 29 + ALONE} of {POSES + 30 + ALONE} poses" in sentence


@pytest.mark.parametrize(
    ("verb", "options", "text"),
    [
        ("train", ("--goal-mm", 1, "--refine", "rig"), "--refine takes one mesh"),
        ("record", ("--all", "--refine", "m.onnx"), "--refine takes one mesh"),
        ("record", ("--all", "--object", BODY), "give one of them"),
        ("evaluate", ("--json", "e.json", "--heatmap", "h.png"), "--heatmap draws one mesh"),
    ],
)
def test_options_for_one_mesh_are_refused_for_several(two, tmp_path, monkeypatch, capfd, verb, options, text):
    monkeypatch.chdir(tmp_path)
    options = [two.rig if option == "rig" else option for option in options]
    first = {
        "train": (two.recordings, "models"),
        "record": (two.rig, two.recordings),
        "evaluate": (two.rig, two.models),
    }
    assert run(verb, *first[verb], *options) == 2
    assert text in capfd.readouterr().err
    assert file_contents(tmp_path) == {}


def test_a_full_disk_is_refused_before_anything_is_recorded(two, tmp_path, capfd):
    sentence = Refusal(tmp_path, capfd)("record", two.rig, tmp_path / "r", "--all", "--poses", 10**11, status=TRY_AGAIN)
    assert f"Cannot write the recording '{tmp_path / 'r' / BODY}': it takes 745" in sentence
    assert sentence.endswith(" GB left; make room, record fewer poses, or choose another folder.")
