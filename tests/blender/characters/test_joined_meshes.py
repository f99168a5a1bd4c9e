# SPDX-License-Identifier: GPL-3.0-or-later
"""One recording and one model of a body, a sleeve, and a cuff without weights whose object is elsewhere."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
import pytest

import fdda_addon
from blend_fixtures.characters.base import cage, link
from blend_fixtures.characters.meshes import dressed_limb
from blend_fixtures.elbow import skin
from fdda_addon.core.formats.model import read_model_info
from fdda_addon.core.formats.report import read_report
from fdda_addon.core.recording.index import read_index
from fdda_addon.core.recording.reader import Recording, read_recording
from fdda_addon.poses.action_range import measured_controls
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.recording.run import record
from fdda_addon.scene.blend_file import save_copy
from fdda_addon.scene.scene_rig import find_whole_character
from fdda_addon.training.environment.choice import PYTHON_VARIABLE

from ..conftest import CommandOutput, output_of, run
from ..refusals import Refusal, file_contents

BODY, SLEEVE, CUFF = NAMES = ("elbow", "sleeve", "cuff")
POSES, FRAMES = 80, 30
OPTIONS = ("--poses", POSES, "--action", "elbow_wave")


@dataclass(frozen=True)
class Files:
    """Files of the character, and what `record` and `train` printed."""

    folder: Path
    rig: Path
    recording: Path
    model: Path
    recorded: CommandOutput
    trained: CommandOutput


@pytest.fixture(scope="module")
def dressed(tmp_path_factory: pytest.TempPathFactory) -> Files:
    folder = tmp_path_factory.mktemp("dressed")
    rig, recording, model = (folder / name for name in ("rig.blend", "recording", "model.onnx"))
    fdda_addon.register()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    dressed_limb()
    save_copy(rig)
    recorded = output_of("record", rig, recording, "--all", *OPTIONS)
    trained = output_of("train", recording, model, "--passes", 8, "--hidden", 16)
    fdda_addon.unregister()
    return Files(folder, rig, recording, model, recorded, trained)


def changed(dressed: Files, path: Path, change: Callable[[], object]) -> Path:
    """Save a copy of the file with a change."""
    bpy.ops.wm.open_mainfile(filepath=str(dressed.rig))
    change()
    save_copy(path)
    return path


def to_first_space(recording: Recording, index: int, positions: np.ndarray) -> np.ndarray:
    matrix = recording.rig.meshes[index].matrix
    return positions @ matrix[:3, :3].T + matrix[:3, 3]


def test_one_recording_has_all_meshes_with_weights_first(dressed):
    recording = read_recording(dressed.recording)
    assert [(mesh.name, mesh.vertices) for mesh in recording.rig.meshes] == [(name, 300) for name in NAMES]
    assert [np.array_equal(mesh.matrix, np.eye(4)) for mesh in recording.rig.meshes] == [True, True, False]
    assert recording.rig.face_vertices.max() == 899 and recording.rig.unweighted_vertices.tolist() == [*range(600, 900)]
    assert (
        dressed.recorded.out[-1].startswith(f"{dressed.recording}: ")
        and ", of 3 meshes, in " in dressed.recorded.out[-1]
    )


def test_each_mesh_is_where_it_is_by_itself(dressed, tmp_path):
    """All in the space of the first: also the cuff, whose object is at another place."""
    joined = read_recording(dressed.recording)
    for index, (name, vertices) in enumerate(zip(NAMES, joined.rig.mesh_slices, strict=True)):
        options = ("--object", name, "--poses", 0, "--action", "elbow_wave")
        assert run("record", dressed.rig, tmp_path / name, *options) == 0
        alone = read_recording(tmp_path / name)
        frames = joined.positions[POSES : POSES + FRAMES, vertices]
        assert np.abs(frames - to_first_space(joined, index, alone.positions[:FRAMES])).max() < 1e-6
        rest = to_first_space(joined, index, alone.rig.rest_positions)
        assert np.abs(joined.rig.rest_positions[vertices] - rest).max() < 1e-6


def test_a_key_of_each_mesh_is_an_input_of_its_own(dressed):
    recording, path = read_recording(dressed.recording), 'key_blocks["puff"].value'
    names = [f"shape_keys/{path}", f"shape_keys:sleeve/{path}"]
    assert [control.name for control in recording.rig.controls] == names
    assert all(control.is_shape_key for control in recording.rig.controls)
    values = recording.controls[:POSES]
    assert np.ptp(values, axis=0).min() > 0.5 and abs(np.corrcoef(values.T)[0, 1]) < 0.5


def test_an_action_has_the_range_of_a_key_of_each_mesh(dressed):
    bpy.ops.wm.open_mainfile(filepath=str(dressed.rig))
    action = bpy.data.actions.new("puffs")
    for name, value in ((BODY, 0.25), (SLEEVE, 0.75)):
        shape_keys = bpy.data.objects[name].data.shape_keys
        animation = shape_keys.animation_data_create()
        animation.action, animation.action_slot = action, action.slots.new("KEY", name)
        for frame, key_value in ((1, 0.0), (10, value)):
            shape_keys.key_blocks["puff"].value = key_value
            shape_keys.key_blocks["puff"].keyframe_insert("value", frame=frame)
    controls = measured_controls(find_whole_character()[0], [action])
    assert {(control.owner, control.low, control.high) for control in controls} == {
        ("shape_keys", 0.0, 0.25),
        ("shape_keys:sleeve", 0.0, 0.75),
    }


def test_an_interrupted_recording_resumes_with_the_same_bytes(dressed, tmp_path):
    bpy.ops.wm.open_mainfile(filepath=str(dressed.rig))
    settings = RecordingSettings(poses=POSES, actions=("elbow_wave",), bones_to_pose=("remix",))
    steps = record(find_whole_character()[0], tmp_path / "r", settings)
    for step in steps:
        if step.stage == "poses" and step.done == 7:
            break
    steps.close()
    assert read_index(tmp_path / "r")["complete"] == 7
    assert run("record", dressed.rig, tmp_path / "r", "--all", *OPTIONS, "--resume") == 0
    assert file_contents(tmp_path / "r") == file_contents(dressed.recording)


def test_one_command_records_trains_and_binds_all_meshes(dressed, tmp_path, capfd, monkeypatch):
    command, recording = ("build-model", dressed.rig, tmp_path), tmp_path / "recording"
    shutil.copytree(dressed.recording, recording)
    refusal = Refusal(tmp_path, capfd)
    with monkeypatch.context() as context:
        context.setenv(PYTHON_VARIABLE, str(tmp_path / "nothing"))
        for name in ("bound.blend", "report.json", "report.html", "model.checkpoint.npz"):
            (tmp_path / name).write_text("mine")
            assert "another file is there" in refusal(*command)
            (tmp_path / name).unlink()
        assert "cannot be started" in refusal(*command, "--overwrite")
        assert "There is no file" in refusal("build-model", dressed.folder / "none.blend", tmp_path)
        assert run(*command, "--pre-roll", 3) == 2
    assert "it was recorded differently" in refusal(*command, "--poses", 3)
    # A complete recording is used even if the default options would record other poses.
    lines = output_of(*command).out
    assert lines[-3:] == [f"{tmp_path / 'bound.blend'}: '{name}' plays model.onnx" for name in NAMES]
    assert file_contents(recording) == file_contents(dressed.recording)


def test_a_model_has_all_meshes_and_its_report_a_line_for_each(dressed):
    info, recording = read_model_info(dressed.model), read_recording(dressed.recording)
    assert info.meshes == recording.rig.meshes and [mesh.name for mesh in info.meshes] == list(NAMES)
    meshes = read_report(dressed.model.with_name("report.json"))["meshes"]
    assert [mesh["name"] for mesh in meshes] == list(NAMES)
    # The fitted weights of the cuff are no worse than those of the body.
    assert all(mesh["held_out"]["mean"] < 0.5 * mesh["linear"]["mean"] for mesh in meshes)
    assert meshes[2]["linear"]["mean"] < 2 * meshes[0]["linear"]["mean"]
    assert [line.partition(":")[0] for line in dressed.trained.err if line.startswith("'")] == [f"'{n}'" for n in NAMES]


@pytest.mark.parametrize("bones", ["auto", 1])
def test_poses_are_added_and_training_continues(dressed, tmp_path, capfd, bones):
    recording, model = tmp_path / "r", tmp_path / "m.onnx"
    options = ("--passes", 4, "--hidden", 16, "--bones-to-read", bones)
    assert run("record", dressed.rig, recording, "--all", *OPTIONS) == 0
    assert run("train", recording, model, *options) == 0
    assert read_model_info(model).has_key_joints is (bones == 1)
    assert run("record", dressed.rig, recording, "--refine", model, "--poses", 5) == 0
    assert read_recording(recording).info.sampling.sources[-1].poses == 5
    assert run("train", recording, model, *options, "--warm-start") == 0


def test_check_recording_does_not_mind_a_mesh_without_weights(dressed, capfd):
    assert run("check-recording", dressed.recording, "--strict") == 0, capfd.readouterr().err


def subdivide_the_body() -> None:
    bpy.data.objects[BODY].modifiers.new("Subdivision", "SUBSURF").levels = 1


def parent_the_cuff_to_a_bone() -> None:
    cuff = bpy.data.objects[CUFF]
    cuff.parent_type, cuff.parent_bone = "BONE", "lower"


def add_a_hat_with_another_armature() -> None:
    other = link(bpy.data.objects["elbow_rig"].copy())
    other.name = "hat_rig"
    skin(cage("hat", 1.3), other)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (subdivide_the_body, "follows the surface of 'elbow' with its modifier 'Subdivision', which is off while"),
        (parent_the_cuff_to_a_bone, "The object 'cuff' moves against 'elbow', and meshes of one recording move"),
        (add_a_hat_with_another_armature, "'elbow' follows the armature 'elbow_rig' and 'hat' follows 'hat_rig'"),
    ],
)
def test_meshes_that_cannot_be_recorded_together_are_named(dressed, tmp_path, capfd, change, sentence):
    rig = changed(dressed, tmp_path / "rig.blend", change)
    assert sentence in Refusal(tmp_path, capfd)("record", rig, tmp_path / "r", "--all", "--poses", 8)


def test_what_all_leaves_out_is_named_with_the_reason(dressed, tmp_path, capfd):
    def change() -> None:
        bpy.data.objects[SLEEVE].hide_viewport = True
        link(bpy.data.objects.new("button", bpy.data.meshes.new("button"))).parent = bpy.data.objects["elbow_rig"]

    rig = changed(dressed, tmp_path / "rig.blend", change)
    assert run("record", rig, tmp_path / "r", "--all", "--poses", 3) == 0
    out = capfd.readouterr().out
    assert "Left out: the mesh 'sleeve', which is hidden; the mesh 'button', which is moved as a whole" in out
    assert [mesh["name"] for mesh in read_index(tmp_path / "r")["meshes"]] == [BODY, CUFF]
