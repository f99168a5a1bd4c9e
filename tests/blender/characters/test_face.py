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
from fdda_addon.scene.control_reader import ControlReader
from fdda_addon.scene.scene_rig import SceneRig

from .. import linked
from ..conftest import Trained, assert_plays, build_and_train, run
from ..rig_changes import trigger_check

MAX_ERROR_RATIO = 0.5
"""Limit for the model's mean error after a short training, as a ratio of linear skinning's mean error."""


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    def build() -> None:
        face.face()
        face.add_performance(bpy.data.objects[face.MESH], face.SPEECH)

    options = ("--poses", 200, "--spread", 10)
    return build_and_train(tmp_path_factory.mktemp("face"), build, *options, training=("--passes", 60))


def test_driven_and_undriven_shape_keys_are_inputs(files):
    recording = read_recording(files.recording)
    assert len(recording.rig.controls) == 22 + 12 and all(control.is_shape_key for control in recording.rig.controls)
    assert np.ptp(recording.controls, axis=0).min() > 0.2


def test_an_action_outside_the_training_data_has_small_errors(files, tmp_path):
    report, speech = tmp_path / "errors.json", ("--action", face.SPEECH)
    assert run("evaluate", files.rig, files.model, "--json", report, "--poses", 0, *speech) == 0
    (errors,) = json.loads(report.read_text())["actions"]
    assert errors["linear"]["max"] > 5
    assert errors["fdda"]["mean"] < MAX_ERROR_RATIO * errors["linear"]["mean"]


def test_the_bound_face_plays_the_action_and_a_shape_key(files, tmp_path):
    bound_path = tmp_path / "bound.blend"
    assert run("bind", files.rig, files.model, bound_path) == 0
    bpy.ops.wm.open_mainfile(filepath=str(bound_path))
    mesh_object, armature_object = bpy.data.objects[face.MESH], bpy.data.objects[face.ARMATURE]
    armature_object.animation_data.action = bpy.data.actions[face.SPEECH]
    keys, shapes = mesh_object.data.shape_keys, []
    for frame, smile in ((1, 0.0), (30, 0.7), (61, 1.0)):
        bpy.context.scene.frame_set(frame)
        keys.key_blocks["smile.L"].value = smile
        bpy.context.view_layer.update()
        shapes.append(assert_plays(mesh_object, files.model))
    assert np.abs(shapes[0] - shapes[1]).max() > 0.003
    # Whatever gives shape keys their values may change.
    for curve in list(keys.animation_data.drivers):
        keys.driver_remove(curve.data_path)
    keys.key_blocks["smile.L"].value = 0.4
    trigger_check("frame")
    assert mesh_object.fdda.mode == "FDDA" and not mesh_object.fdda.status
    assert np.abs(assert_plays(mesh_object, files.model) - shapes[2]).max() > 0.0005


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
def test_the_model_runs_after_the_drivers_of_all_shape_keys(kind, files, tmp_path):
    """Bones and shape keys drive correctives; keys, actions and hands set the others."""
    bound_path = tmp_path / "bound.blend"
    assert run("bind", files.rig, files.model, bound_path) == 0
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
        assert_plays(mesh_object, files.model)
        scene_rig, depsgraph = SceneRig(mesh_object, armature_object), bpy.context.evaluated_depsgraph_get()
        values.append(reader.read(scene_rig, depsgraph))
    assert (np.ptp(values, axis=0) > 0.2).sum() > (30 if kind == "local" else 1)
