# SPDX-License-Identifier: GPL-3.0-or-later
"""A character that can no longer play shows its rig and an error message; other characters keep playing."""

import json
import os
from pathlib import Path

import bpy
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from fdda_addon.core.formats.model import CONTROLS_INPUT, METADATA_KEY
from fdda_addon.runtime.binding import bind
from fdda_addon.runtime.player import Player
from fdda_addon.runtime.session import session
from fdda_addon.scene.scene_rig import find_rig

from ..conftest import ELBOW, ELBOW_RIG, assert_plays, evaluated_positions, pose, write_edited
from ..crowds import crowd_of
from ..rig_changes import change_in_edit_mode


@pytest.mark.parametrize("count", [3, 5], ids=["single", "batched"])
def test_a_character_without_vertices_shows_an_error(bound_elbow, elbow_files, count):
    crowd = crowd_of(bound_elbow, count)
    for frame in (1, 2, 3):
        bpy.context.scene.frame_set(frame)
    crowd[1].data = crowd[1].data.copy()
    change_in_edit_mode(crowd[1], lambda: (bpy.ops.mesh.select_all(action="SELECT"), bpy.ops.mesh.delete(type="VERT")))
    for frame in (4, 9):
        bpy.context.scene.frame_set(frame)
        for mesh_object in [o for o in crowd if o != crowd[1]]:
            assert_plays(mesh_object, elbow_files.model)
    pose(angle=0.4)
    assert_plays(crowd[0], elbow_files.model)
    assert crowd[1].fdda.mode == "RIG" and "has 0 vertices and its model was trained for" in crowd[1].fdda.status


FAILING_METHODS = {
    "created": (Player, "__init__"),
    "object changed": (Player, "fits_object"),
    "rig checked": (Player, "check_rig"),
    "mask read": (Player, "update_mask"),
}


@pytest.mark.parametrize("event", FAILING_METHODS)
def test_an_unexpected_error_stops_one_character_only(bound_elbow, elbow_files, monkeypatch, event):
    crowd = crowd_of(bound_elbow, 3)
    bpy.context.view_layer.update()
    owner, name = FAILING_METHODS[event]
    method, failing_uid = getattr(owner, name), crowd[1].session_uid

    def fail(player: Player, *arguments: object, **keywords: object) -> object:
        if failing_uid in (getattr(player, "object_uid", 0), getattr(arguments[0], "session_uid", 0)):
            raise KeyError("position")
        return method(player, *arguments, **keywords)

    monkeypatch.setattr(owner, name, fail)
    if event == "created":
        session.reset()
    for mesh_object in crowd:
        mesh_object.data.update()
        mesh_object.update_tag()
    bpy.context.view_layer.update()
    bpy.context.scene.frame_set(8)
    for mesh_object in (crowd[0], crowd[2]):
        assert_plays(mesh_object, elbow_files.model)
    assert crowd[1].fdda.mode == "RIG" and "cannot be played (KeyError('position'))" in crowd[1].fdda.status


def add_control_to_model(model: Path, owner: str, path: str) -> Path:
    """Write a copy of a model with a control that has no effect, in the same folder."""

    def add_control(proto: onnx.ModelProto) -> None:
        proto.graph.input.append(helper.make_tensor_value_info(CONTROLS_INPUT, TensorProto.FLOAT, ["N", 1]))
        (metadata,) = (prop for prop in proto.metadata_props if prop.key == METADATA_KEY)
        info = json.loads(metadata.value)
        info["controls"] = [{"owner": owner, "path": path, "low": 0.0, "high": 1.0}]
        metadata.value = json.dumps(info)

    return write_edited(model, model.with_name(f"controlled_{os.getpid()}.onnx"), add_control)


def armature_object() -> bpy.types.Object:
    return bpy.data.objects[ELBOW_RIG]


def shape_keys() -> bpy.types.Key:
    return bpy.data.objects[ELBOW].data.shape_keys


def remove_shape_key() -> None:
    bpy.data.objects[ELBOW].shape_key_remove(shape_keys().key_blocks["smile"])


def delete_property() -> None:
    del armature_object()["dial"]
    # Like the user interface; without the tag, Blender keeps using the old value.
    armature_object().update_tag()


def rename_property() -> None:
    armature_object()["stretch"] = armature_object()["dial"]
    delete_property()


def rename_object() -> None:
    bpy.data.objects["dials"].name = "others"
    session.reset()


SHAPE_KEY_CONTROL = ("shape_keys", 'key_blocks["smile"].value')
BONE_CONTROL = ("armature_object", 'pose.bones["dial"]["fist"]')
OBJECT_CONTROL = ("object:dials", "location[2]")
CONTROL_REMOVALS = {
    "a property is deleted": (("armature_object", '["dial"]'), delete_property),
    "a property is renamed": (("armature_object", '["dial"]'), rename_property),
    "a shape key is removed": (SHAPE_KEY_CONTROL, remove_shape_key),
    "all shape keys are removed": (SHAPE_KEY_CONTROL, lambda: bpy.data.objects[ELBOW].shape_key_clear()),
    "a shape key is renamed": (SHAPE_KEY_CONTROL, lambda: setattr(shape_keys().key_blocks["smile"], "name", "grin")),
    "a bone is renamed": (BONE_CONTROL, lambda: setattr(armature_object().data.bones["dial"], "name", "knob")),
    "an object is removed": (OBJECT_CONTROL, lambda: bpy.data.objects.remove(bpy.data.objects["dials"])),
    "an object is renamed": (OBJECT_CONTROL, rename_object),
}  # fmt: skip


@pytest.mark.parametrize("update", ["pose", "frame"])
@pytest.mark.parametrize("removal", CONTROL_REMOVALS)
def test_a_character_that_lacks_a_control_shows_its_rig(rig, elbow_files, removal, update):
    mesh_object = rig.mesh_object
    armature_object()["dial"] = 0.5
    mesh_object.shape_key_add(name="Basis")
    mesh_object.shape_key_add(name="smile").value = 0.5
    dials = bpy.data.objects.new("dials", None)
    bpy.context.scene.collection.objects.link(dials)
    bpy.context.view_layer.objects.active = armature_object()
    bpy.ops.object.mode_set(mode="EDIT")
    bone = armature_object().data.edit_bones.new("dial")
    bone.head, bone.tail, bone.use_deform = (1, 0, 0), (1, 0, 0.2), False
    bpy.ops.object.mode_set(mode="OBJECT")
    armature_object().pose.bones["dial"]["fist"] = 0.5
    (owner, path), change = CONTROL_REMOVALS[removal]
    bind(find_rig(), add_control_to_model(elbow_files.model, owner, path))
    pose(angle=1.0)
    assert mesh_object.fdda.mode == "FDDA" and not mesh_object.fdda.status
    change()
    if update == "pose":
        pose(angle=0.6)
    else:
        bpy.context.scene.frame_set(11)
    assert mesh_object.fdda.mode == "RIG"
    assert f"'elbow' lacks the control '{owner}/{path}'" in mesh_object.fdda.status
    shown = evaluated_positions(mesh_object)
    mesh_object.modifiers.remove(mesh_object.modifiers["FDDA"])
    assert np.array_equal(evaluated_positions(mesh_object), shown)
