# SPDX-License-Identifier: GPL-3.0-or-later
"""A face with bones, shape keys and correctives, trained with its controls and evaluated on another action."""

import json
from pathlib import Path

import bpy
import numpy as np
import pytest

import fdda_addon
from blend_fixtures.characters import face
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.runtime.model_files import network_of
from fdda_addon.scene.blend_file import save_copy
from fdda_addon.scene.control_reader import ControlReader
from fdda_addon.scene.mesh import evaluated_positions
from fdda_addon.scene.scene_rig import SceneRig

from .. import linked
from ..conftest import assert_plays, run, train
from ..rig_changes import trigger_check

MAX_ERROR_RATIO = 0.5
"""Limit for the model's mean error after a short training, as a ratio of linear skinning's mean error."""


@pytest.fixture(scope="module")
def face_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build, record and train the face; return the folder of its files."""
    folder = tmp_path_factory.mktemp("face")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    face.face()
    face.add_speech()
    save_copy(folder / "face.blend")
    options = ("--poses", 200, "--spread", 10)
    assert run("record", folder / "face.blend", folder / "recording", *options) == 0
    train(folder / "recording", folder / "face.onnx", "--passes", 60)
    return folder


@pytest.fixture
def face_object(face_folder: Path) -> bpy.types.Object:
    """Open the file of the face, and return its mesh object."""
    bpy.ops.wm.open_mainfile(filepath=str(face_folder / "face.blend"))
    return bpy.data.objects[face.MESH]


def test_driven_and_undriven_shape_keys_are_inputs(face_object, face_folder):
    keys = face_object.data.shape_keys
    driven_paths = {curve.data_path for curve in keys.animation_data.drivers}
    undriven_names = [
        block.name for block in keys.key_blocks[1:] if f'key_blocks["{block.name}"].value' not in driven_paths
    ]
    bones = bpy.data.objects[face.ARMATURE].pose.bones
    assert len(face_object.data.vertices) >= 5000
    assert (len(undriven_names), len(bones), len(driven_paths)) == (22, 22, 12)
    recording = read_recording(face_folder / "recording")
    controls = {control.name for control in recording.rig.controls}
    assert controls == {f'shape_keys/key_blocks["{block.name}"].value' for block in keys.key_blocks[1:]}
    assert np.ptp(recording.controls, axis=0).min() > 0.2


@pytest.mark.parametrize(("first", "second"), face._corrective_moves(), ids="-".join)
def test_a_corrective_needs_both_of_its_controls(face_object, first, second):
    """The value of a corrective is 0 if one of its two controls is 0, and grows with both."""
    blocks, jaw = face_object.data.shape_keys.key_blocks, bpy.data.objects[face.ARMATURE].pose.bones["jaw"]
    corrective = blocks[f"{first}_{second}"]

    def corrective_value(first_value: float, second_value: float) -> float:
        blocks[first].value = first_value
        if second == "jaw":
            jaw.rotation_euler[0] = -second_value * face.JAW_OPENING
        else:
            blocks[second].value = second_value
        bpy.context.view_layer.update()
        graph = bpy.context.evaluated_depsgraph_get()
        evaluated_positions(face_object, graph)
        return face_object.evaluated_get(graph).data.shape_keys.key_blocks[corrective.name].value

    assert [round(corrective_value(*values), 3) for values in ((0, 1), (1, 0), (1, 0.5), (1, 1))] == [0, 0, 0.5, 1]


def test_an_action_outside_the_training_data_has_small_errors(face_folder, tmp_path):
    report, speech = tmp_path / "errors.json", ("--action", face.SPEECH)
    assert (
        run("evaluate", face_folder / "face.blend", face_folder / "face.onnx", "--json", report, "--poses", 0, *speech)
        == 0
    )
    (errors,) = json.loads(report.read_text())["actions"]
    assert errors["linear"]["max"] > 5
    assert errors["fdda"]["mean"] < MAX_ERROR_RATIO * errors["linear"]["mean"]


def test_the_bound_face_plays_the_action_and_a_shape_key(face_folder, tmp_path):
    bound_path = tmp_path / "bound.blend"
    assert run("bind", face_folder / "face.blend", face_folder / "face.onnx", bound_path) == 0
    bpy.ops.wm.open_mainfile(filepath=str(bound_path))
    mesh_object, armature_object = bpy.data.objects[face.MESH], bpy.data.objects[face.ARMATURE]
    armature_object.animation_data.action = bpy.data.actions[face.SPEECH]
    keys, shapes = mesh_object.data.shape_keys, []
    for frame, smile in ((1, 0.0), (30, 0.7), (61, 1.0)):
        bpy.context.scene.frame_set(frame)
        keys.key_blocks["smile.L"].value = smile
        bpy.context.view_layer.update()
        shapes.append(assert_plays(mesh_object, face_folder / "face.onnx"))
    assert np.abs(shapes[0] - shapes[1]).max() > 0.003
    # Whatever gives shape keys their values may change.
    for curve in list(keys.animation_data.drivers):
        keys.driver_remove(curve.data_path)
    keys.key_blocks["smile.L"].value = 0.4
    trigger_check("frame")
    assert mesh_object.fdda.mode == "FDDA" and not mesh_object.fdda.status
    assert np.abs(assert_plays(mesh_object, face_folder / "face.onnx") - shapes[2]).max() > 0.0005


def override_face(bound_path: Path, shot_path: Path) -> bpy.types.Object:
    """Save the bound face in a collection, and return the mesh object of its library override in a shot."""
    bpy.ops.wm.open_mainfile(filepath=str(bound_path))
    collection = bpy.data.collections.new(linked.COLLECTION)
    bpy.context.scene.collection.children.link(collection)
    for name in (face.MESH, face.ARMATURE):
        bpy.context.scene.collection.objects.unlink(bpy.data.objects[name])
        collection.objects.link(bpy.data.objects[name])
    for block in bpy.data.objects[face.MESH].data.shape_keys.key_blocks[1:]:
        block.value = 0.5
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    fdda_addon.register()
    bpy.ops.wm.save_as_mainfile(filepath=str(shot_path))
    return linked.override_character(linked.link_character(bound_path))


@pytest.mark.parametrize("kind", ["local", "linked and overridden"])
def test_the_model_runs_after_the_drivers_of_all_shape_keys(kind, face_folder, tmp_path):
    """Bones and shape keys drive correctives; keys, actions and hands set the others."""
    bound_path = tmp_path / "bound.blend"
    assert run("bind", face_folder / "face.blend", face_folder / "face.onnx", bound_path) == 0
    if kind == "local":
        bpy.ops.wm.open_mainfile(filepath=str(bound_path))
        mesh_object = bpy.data.objects[face.MESH]
    else:
        mesh_object = override_face(bound_path, tmp_path / "shot.blend")
    armature_object = linked.armature_of(mesh_object)
    bpy.context.view_layer.update()
    bones, rng = armature_object.pose.bones, np.random.default_rng(1)
    reader = ControlReader(SceneRig(mesh_object, armature_object), network_of(mesh_object).info.controls)
    values = []
    for _ in range(20):
        for bone in bones:
            bone.rotation_mode, bone.rotation_euler = "XYZ", rng.uniform(-0.4, 0.0, 3)
        if kind == "local":
            for block in mesh_object.data.shape_keys.key_blocks[1:]:
                block.value = rng.uniform(0, 1)
        bpy.context.view_layer.update()
        assert_plays(mesh_object, face_folder / "face.onnx")
        scene_rig, depsgraph = SceneRig(mesh_object, armature_object), bpy.context.evaluated_depsgraph_get()
        values.append(reader.read(scene_rig, depsgraph))
    assert (np.ptp(values, axis=0) > 0.2).sum() > (30 if kind == "local" else 1)
