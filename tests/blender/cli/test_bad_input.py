# SPDX-License-Identifier: GPL-3.0-or-later
"""Verbs that refuse bad rigs, recordings and outputs with one error message, and change no file.

Bad models are in test_bad_models.py, bad trainers in test_bad_trainers.py.
"""

import shutil
from pathlib import Path

import bpy
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
        (lambda rig: rig.mesh_object.data.clear_geometry(), (), "The mesh of 'elbow' has no vertices"),
        (add_second_mesh, ("--object", "glove"), "no mesh object 'glove'; its mesh objects: 'elbow', 'sleeve'."),
        (add_second_mesh, (), "2 meshes have an Armature modifier ('elbow', 'sleeve'); choose one with --object."),
        (remove_armature, (), "No mesh of the scene has an Armature modifier with an armature"),
        (remove_armature, ("--object", "elbow"), "'elbow' has no Armature modifier with an armature"),
    ],
)
def test_a_file_without_a_character_is_refused(refusal, verb, tmp_path, change, options, message):
    assert message in refusal(*verb(save_elbow(tmp_path / "rig.blend", change), *options))


def lock_all_rotations(rig) -> None:
    for bone in rig.armature_object.pose.bones:
        bone.lock_rotation = (True, True, True)


def test_a_rig_whose_bones_are_all_locked_is_refused(refusal, elbow_files, tmp_path):
    path = save_elbow(tmp_path / "rig.blend", lock_all_rotations)
    expected = "No bone of 'elbow_rig' may be sampled: all 2 are locked or moved by constraints; unlock an axis"
    assert refusal("record", path, tmp_path / "r").startswith(expected)


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
