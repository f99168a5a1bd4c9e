# SPDX-License-Identifier: GPL-3.0-or-later
"""Fast rigs of several meshes, of files with relative paths, and with controls that move nothing."""

import json
from pathlib import Path

import bpy

from blend_fixtures.characters.bones import NewBone, add_bones
from fdda_addon.core.formats.model import METADATA_KEY
from fdda_addon.scene.blend_file import save_copy

from ..command_output import output_of
from ..conftest import ELBOW, ELBOW_RIG, assert_plays, run, write_edited
from ..waves import wave

OTHER = "a second: arm"


def rename_object(name: str):
    """Return a function that changes the object name in the metadata of a model."""

    def edit(proto):
        (prop,) = (prop for prop in proto.metadata_props if prop.key == METADATA_KEY)
        info = json.loads(prop.value)
        info["meshes"][0]["name"] = name
        prop.value = json.dumps(info)

    return edit


def test_a_folder_of_models_makes_one_fast_rig_with_all_meshes(elbow_files, tmp_path):
    bpy.ops.wm.open_mainfile(filepath=str(elbow_files.rig))
    other = bpy.data.objects[ELBOW].copy()
    other.name, other.data = OTHER, other.data.copy()
    bpy.context.scene.collection.objects.link(other)
    save_copy(tmp_path / "full.blend")
    models = tmp_path / "models"
    models.mkdir()
    (models / "one.onnx").write_bytes(elbow_files.model.read_bytes())
    write_edited(elbow_files.model, models / "two.onnx", rename_object(OTHER))

    assert run("fast-rig", tmp_path / "full.blend", models, tmp_path / "fast.blend", "--frames", 0) == 0
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "fast.blend"))
    bpy.data.objects[ELBOW_RIG].pose.bones[-1].rotation_mode = "XYZ"
    bpy.data.objects[ELBOW_RIG].pose.bones[-1].rotation_euler = (0.5, 0.0, 0.3)
    bpy.context.view_layer.update()
    for name in (ELBOW, OTHER):
        mesh_object = bpy.data.objects[name]
        assert mesh_object.fdda.is_fast_rig and not mesh_object.fdda.status
        assert "CorrectiveSmooth" not in mesh_object.modifiers
        assert_plays(mesh_object, elbow_files.model)


def test_relative_paths_lead_to_the_same_files_from_another_folder(elbow_files, tmp_path):
    source, out = tmp_path / "character", tmp_path / "animation" / "rigs"
    (source / "textures").mkdir(parents=True)
    out.mkdir(parents=True)
    texture = source / "textures" / "skin.png"
    bpy.ops.wm.open_mainfile(filepath=str(elbow_files.rig))
    made = bpy.data.images.new("made", 4, 4)
    made.save(filepath=str(texture))
    bpy.data.images.remove(made)
    full = source / "full.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(full))
    image = bpy.data.images.load("//textures/skin.png")
    image.name, image.use_fake_user = "skin", True
    bpy.ops.wm.save_mainfile()
    fast = out / "fast.blend"
    assert run("fast-rig", full, elbow_files.model, fast, "--object", ELBOW, "--frames", 0) == 0
    bpy.ops.wm.open_mainfile(filepath=str(fast))
    path = bpy.data.images["skin"].filepath
    assert path.startswith("//") and Path(bpy.path.abspath(path)).resolve() == texture.resolve()


def test_controls_that_choose_no_bone_are_refused(elbow_files, tmp_path, capsys):
    bpy.ops.wm.open_mainfile(filepath=str(elbow_files.rig))
    for action in list(bpy.data.actions):
        bpy.data.actions.remove(action)
    save_copy(tmp_path / "full.blend")
    fast = tmp_path / "fast.blend"
    assert run("fast-rig", tmp_path / "full.blend", elbow_files.model, fast, "--controls", "keyed") == 1
    assert "'elbow_rig' has no bones for --controls keyed, so the fast rig would have" in capsys.readouterr().err
    assert not fast.exists()


def test_controls_that_move_no_joint_prove_nothing(elbow_files, tmp_path):
    bpy.ops.wm.open_mainfile(filepath=str(elbow_files.rig))
    for action in list(bpy.data.actions):
        bpy.data.actions.remove(action)
    armature_object = bpy.data.objects[ELBOW_RIG]
    add_bones(armature_object, NewBone("aside", (0.0, 0.0, 0.3), (0.1, 0.0, 0.3), is_deforming=False))
    wave(armature_object, "aside")
    save_copy(tmp_path / "full.blend")
    files = (tmp_path / "full.blend", elbow_files.model, tmp_path / "fast.blend")
    lines = output_of("fast-rig", *files, "--controls", "keyed", "--frames", 0).out
    assert lines[2].startswith(
        "  no joint moves in 220 poses of these controls, so nothing shows that the joints move as "
    )
    assert len(lines) == 3
