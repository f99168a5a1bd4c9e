# SPDX-License-Identifier: GPL-3.0-or-later
"""Verbs that refuse bad rigs, recordings and outputs with one error message, and change no file.

Bad models are in test_bad_models.py, bad trainers in test_bad_trainers.py.
"""

import json
import shutil
from pathlib import Path

import bpy
import numpy as np
import pytest

from ... import systems
from ..refusals import file_contents, limited_file_size, save_elbow

pytestmark = pytest.mark.one_blender_version


@pytest.fixture(params=["record", "bind", "evaluate", "benchmark"])
def verb(request, elbow_files, tmp_path):
    """Return, for each verb that opens a rig, a function from the rig's path to the verb's arguments."""
    more_arguments = {
        "record": [tmp_path / "recording"],
        "bind": [elbow_files.model, tmp_path / "bound.blend"],
        "evaluate": [elbow_files.model, "--json", tmp_path / "e.json", "--poses", "2"],
        "benchmark": [elbow_files.model, "--json", tmp_path / "b.json", "--frames", "5"],
    }[request.param]
    return lambda rig_path, *options: [request.param, rig_path, *more_arguments, *options]


def test_a_missing_rig_file_is_refused(refusal, verb, tmp_path):
    path = tmp_path / "none.blend"
    assert refusal(*verb(path)) == f"There is no file '{path}'; give the path of a .blend file."
    assert "There is no file" in refusal(*verb(tmp_path))


def test_a_rig_that_is_not_a_blend_file_is_refused(refusal, verb, tmp_path):
    path = tmp_path / "text.blend"
    path.write_text("not a blend file\n" * 100)
    text = refusal(*verb(path))
    assert text.startswith(f"Blender cannot open '{path}' (") and text.endswith("); give a .blend file.")


def test_a_scene_without_a_mesh_is_refused(refusal, verb, tmp_path):
    path = save_elbow(tmp_path / "rig.blend", lambda rig: bpy.data.objects.remove(rig.mesh_object))
    assert refusal(*verb(path)).startswith("The scene has no mesh; open a file with a character")


def add_second_mesh(rig) -> None:
    second = rig.mesh_object.copy()
    second.name = "sleeve"
    bpy.context.scene.collection.objects.link(second)


def test_a_scene_with_two_skinned_meshes_needs_the_option_object(refusal, verb, tmp_path):
    path = save_elbow(tmp_path / "rig.blend", add_second_mesh)
    assert refusal(*verb(path, "--object", "glove")) == (
        "The scene has no mesh object 'glove'; its mesh objects: 'elbow', 'sleeve'."
    )
    assert refusal(*verb(path)) == ("2 meshes have an Armature modifier ('elbow', 'sleeve'); choose one with --object.")


def test_a_mesh_without_an_armature_modifier_is_refused(refusal, verb, tmp_path):
    def remove_armature(rig):
        rig.mesh_object.parent = None
        rig.mesh_object.modifiers.remove(rig.mesh_object.modifiers["Armature"])

    path = save_elbow(tmp_path / "rig.blend", remove_armature)
    assert "No mesh of the scene has an Armature modifier with an armature" in refusal(*verb(path))
    assert "'elbow' has no Armature modifier with an armature" in refusal(*verb(path, "--object", "elbow"))


def lock_all_rotations(rig) -> None:
    for bone in rig.armature_object.pose.bones:
        bone.lock_rotation = (True, True, True)


def test_a_rig_whose_bones_are_all_locked_is_refused(refusal, elbow_files, tmp_path):
    path = save_elbow(tmp_path / "rig.blend", lock_all_rotations)
    expected = "No bone of 'elbow_rig' may be sampled: all 2 are locked or moved by constraints; unlock an axis"
    assert refusal("record", path, tmp_path / "r").startswith(expected)


def test_a_mesh_without_vertices_is_refused(refusal, verb, tmp_path):
    path = save_elbow(tmp_path / "rig.blend", lambda rig: rig.mesh_object.data.clear_geometry())
    assert "The mesh of 'elbow' has no vertices" in refusal(*verb(path))


def write_nan(path) -> None:
    array = np.load(path / "positions.npy")
    array[3, 2, 1] = np.nan
    np.save(path / "positions.npy", array)


def slow_case(damage, words: str, case_name: str):
    """Return a case for `make test-slow`, because it starts a trainer."""
    return pytest.param(damage, words, id=case_name, marks=pytest.mark.slow)


def index_changer(**values):
    def change(path):
        index = json.loads((path / "recording.json").read_text())
        (path / "recording.json").write_text(json.dumps({**index, **values}))

    return change


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        slow_case(
            index_changer(complete=40), "is incomplete: 40 of 162 poses; finish it with record --resume", "incomplete"
        ),
        pytest.param(write_nan, "holds values that are not numbers (positions, pose 3); record again", id="NaN"),
    ],
)
def test_training_on_a_damaged_recording_is_refused(refusal, elbow_files, tmp_path, damage, words):
    path = shutil.copytree(elbow_files.recording, tmp_path / "recording")
    damage(path)
    assert words in refusal("train", path, tmp_path / "m.onnx")


def test_recording_into_a_folder_with_a_recording_is_refused(refusal, elbow_files, tmp_path):
    path = shutil.copytree(elbow_files.recording, tmp_path / "recording")
    assert "holds a recording already; continue it with --resume" in refusal("record", elbow_files.rig, path)


def test_resuming_with_other_options_is_refused(refusal, elbow_files, tmp_path):
    path = shutil.copytree(elbow_files.recording, tmp_path / "recording")
    index_changer(complete=40)(path)
    text = refusal("record", elbow_files.rig, path, "--poses", 150, "--seed", 1, "--resume")
    assert "it was recorded differently (sampling.seed);" in text
    text = refusal("record", elbow_files.rig, path, "--poses", 160, "--resume")
    assert "it was recorded differently (poses, sampling.sources);" in text


@pytest.fixture(params=["build-arm", "record", "bind", "evaluate", "heatmap", "benchmark"])
def writing_verb(request, elbow_files, tmp_path_factory):
    """Return, for each verb that writes a file, a function from the output path to the verb's arguments."""
    return {
        "build-arm": lambda out: ["build-arm", out],
        "record": lambda out: ["record", elbow_files.rig, out, "--poses", 60],
        "bind": lambda out: ["bind", elbow_files.rig, elbow_files.model, out],
        "evaluate": lambda out: ["evaluate", elbow_files.rig, elbow_files.model, "--json", out, "--poses", 2],
        "heatmap": lambda out: [
            "evaluate",
            elbow_files.rig,
            elbow_files.model,
            "--poses",
            2,
            "--json",
            tmp_path_factory.mktemp("json") / "e.json",
            "--heatmap",
            out,
        ],
        "benchmark": lambda out: ["benchmark", elbow_files.rig, elbow_files.model, "--json", out, "--frames", 5],
    }[request.param]


def test_an_output_that_cannot_be_written_is_refused(refusal, writing_verb, tmp_path):
    (tmp_path / "file").write_text("old")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "letter.txt").write_text("dear")
    assert refusal(*writing_verb(tmp_path / "file" / "out")).startswith("Cannot write")
    assert refusal(*writing_verb(systems.UNWRITABLE)).startswith("Cannot write")
    assert refusal(*writing_verb(tmp_path / "folder")).startswith("Cannot ")


def test_an_output_in_a_missing_folder_is_refused(refusal, writing_verb, tmp_path):
    if writing_verb("")[0] == "record":
        pytest.skip("record makes its folder")
    text = refusal(*writing_verb(tmp_path / "none" / "out"))
    assert f"the folder '{tmp_path / 'none'}' does not exist; create it first" in text


def deep_path(folder: Path) -> Path:
    """Return a path that exceeds Blender's limit for paths; the limit falls inside a folder name."""
    return folder.joinpath(*(letter * 200 for letter in "abcdef"))


def test_an_output_path_that_is_too_long_for_blender_is_refused(refusal, writing_verb, tmp_path):
    """Blender would truncate the path, and could overwrite another file."""
    text = refusal(*writing_verb(deep_path(tmp_path) / "out.blend"))
    assert text.startswith("Cannot write") and "bytes, and Blender takes 1,023; choose a shorter folder." in text


def test_a_rig_path_that_is_too_long_for_blender_is_refused(refusal, verb, elbow_files, tmp_path):
    path = deep_path(tmp_path) / "rig.blend"
    path.parent.mkdir(parents=True)
    shutil.copy(elbow_files.rig, path)
    text = refusal(*verb(path))
    assert text.startswith("Blender cannot open or write") and "bytes, and Blender takes 1,023; choose a sh" in text


@pytest.mark.parametrize("is_present", [False, True])
def test_an_output_on_a_full_disk_is_refused_and_an_old_file_stays(
    refusal_on_a_full_disk, writing_verb, tmp_path, is_present
):
    if is_present and writing_verb("")[0] == "record":
        pytest.skip("record replaces nothing")
    if is_present:
        (tmp_path / "out").write_text("old")
    with limited_file_size(100):
        text = refusal_on_a_full_disk(*writing_verb(tmp_path / "out"))
    assert text.startswith("Cannot write"), text
    if is_present:
        assert file_contents(tmp_path) == {"out": b"old"}


def test_a_model_that_cannot_be_copied_beside_the_bound_file_is_refused(refusal, elbow_files, tmp_path):
    (tmp_path / elbow_files.model.name).write_bytes(b"another model")
    text = refusal("bind", elbow_files.rig, elbow_files.model, tmp_path / "b.blend")
    assert f"there is another '{elbow_files.model.name}'; remove it or choose another folder" in text
