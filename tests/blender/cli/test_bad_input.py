# SPDX-License-Identifier: GPL-3.0-or-later
"""Verbs that refuse bad rigs, models, recordings and outputs with one error message, and change no file."""

import shutil
from pathlib import Path

import bpy
import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper

from fdda_addon.runtime.binding import bind
from fdda_addon.scene.scene_rig import find_rig

from ... import systems
from ..conftest import write_edited
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


def add_second_mesh(rig) -> None:
    second = rig.mesh_object.copy()
    second.name = "sleeve"
    bpy.context.scene.collection.objects.link(second)


def remove_armature(rig) -> None:
    rig.mesh_object.parent = None
    rig.mesh_object.modifiers.remove(rig.mesh_object.modifiers["Armature"])


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        (lambda rig: bpy.data.objects.remove(rig.mesh_object), (), "The scene has no mesh; open a file with a charac"),
        (
            lambda rig: rig.mesh_object.data.clear_geometry(),
            (),
            "'elbow' has no size: 0 vertices at one point",
        ),
        (add_second_mesh, ("--object", "glove"), "no mesh object 'glove'; its mesh objects: 'elbow', 'sleeve'."),
        (add_second_mesh, (), "2 meshes have an Armature modifier ('elbow', 'sleeve'); choose one with --object."),
        (remove_armature, (), "No mesh of the scene has an Armature modifier with an armature"),
        (remove_armature, ("--object", "elbow"), "'elbow' has no Armature modifier with an armature"),
    ],
)
def test_a_file_without_a_character_is_refused(refusal, verb, tmp_path, change, options, message):
    assert message in refusal(*verb(save_elbow(tmp_path / "rig.blend", change), *options))


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
    if writing_verb("")[0] != "record":  # It makes its folder.
        text = refusal(*writing_verb(tmp_path / "none" / "out"))
        assert f"the folder '{tmp_path / 'none'}' does not exist; create it first" in text


def deep_path(folder: Path) -> Path:
    """Return a path that exceeds Blender's limit for paths; the limit falls inside a folder name."""
    return folder.joinpath(*(letter * 200 for letter in "abcdef"))


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


@pytest.fixture(params=["bind", "evaluate", "benchmark"])
def model_verb(request, tmp_path):
    """Return, for each verb that reads a model, a function from the paths of rig and model to its arguments."""
    more_arguments = {
        "bind": [tmp_path / "bound.blend"],
        "evaluate": ["--json", tmp_path / "e.json", "--poses", "2"],
        "benchmark": ["--json", tmp_path / "b.json", "--frames", "5"],
    }[request.param]
    return lambda rig, model: [request.param, rig, model, *more_arguments]


def rename_bone(rig) -> None:
    rig.armature_object.data.bones["lower"].name = "forearm"


def test_a_model_of_another_rig_is_refused(refusal, model_verb, elbow_files, tmp_path):
    text = refusal(*model_verb(save_elbow(tmp_path / "rig.blend", rename_bone), elbow_files.model))
    words = "the armature lacks the joint 'lower'; it does not know the joint 'forearm'. Record and train this rig."
    assert text == f"The model '{elbow_files.model}' was trained for another rig: {words}"


def test_a_missing_model_is_refused(refusal, model_verb, elbow_files, tmp_path):
    path = tmp_path / "none.onnx"
    text = refusal(*model_verb(elbow_files.rig, path))
    assert text.startswith(f"The model '{path}' cannot be read: {systems.NOT_FOUND}; ")


def remove_metadata(model) -> None:
    del model.metadata_props[:]


def use_double_input(model) -> None:
    model.graph.input[0].type.tensor_type.elem_type = TensorProto.DOUBLE


@pytest.mark.parametrize(
    ("change", "start", "end"),
    [
        (remove_metadata, "The model '", " is an ONNX file but not a model of this add-on; give one that train made."),
        (use_double_input, "ONNX Runtime refuses the model '", "); train it again."),
    ],
)
def test_onnx_files_that_are_not_models_are_refused(refusal, model_verb, elbow_files, tmp_path, change, start, end):
    path = write_edited(elbow_files.model, tmp_path / "m.onnx", change)
    text = refusal(*model_verb(elbow_files.rig, path))
    assert text.startswith(start + str(path)) and text.endswith(end)


def output_nan(model) -> None:
    """Multiply the output positions by NaN."""
    last = next(node for node in model.graph.node if "positions" in node.output)
    last.output[list(last.output).index("positions")] = "good"
    model.graph.initializer.append(numpy_helper.from_array(np.float32([np.nan]), "nan"))
    model.graph.node.append(helper.make_node("Mul", ["good", "nan"], ["positions"]))


def test_evaluation_of_a_model_that_returns_nan_is_refused(refusal, elbow_files, tmp_path):
    path = write_edited(elbow_files.model, tmp_path / "m.onnx", output_nan)
    text = refusal("evaluate", elbow_files.rig, path, "--json", tmp_path / "e.json", "--poses", 2)
    assert f"The model '{path}' gives positions that are not numbers (held-out poses, pose 0)" in text


def test_playing_a_model_that_returns_nan_shows_an_error(bound_elbow, elbow_files, tmp_path):
    bind(find_rig(), write_edited(elbow_files.model, tmp_path / "m.onnx", output_nan))
    bpy.context.view_layer.update()
    assert "gives positions that are not numbers; train it again." in bound_elbow.fdda.status
    assert bound_elbow.fdda.mode == "FDDA"
