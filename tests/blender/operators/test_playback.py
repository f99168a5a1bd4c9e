# SPDX-License-Identifier: GPL-3.0-or-later
"""The operators of the section Model, without a window: bind, switch, measure, find a file, unbind."""

import shutil

import bpy
import numpy as np
import pytest

from fdda_addon.runtime import confidence, model_files
from fdda_addon.timing import measurements
from fdda_addon.timing.benchmark import LABELS

from ..conftest import ELBOW, ELBOW_RIG, assert_plays, evaluated_positions, pose
from ..refusals import refused


def modifiers(mesh_object: bpy.types.Object) -> list[tuple]:
    return [(m.name, m.type, m.show_viewport, m.show_render) for m in mesh_object.modifiers]


def test_bind_plays_and_unbind_restores(rig, elbow_files):
    mesh_object = rig.mesh_object
    mesh_object.modifiers["CorrectiveSmooth"].show_render = False
    before, datablocks = modifiers(mesh_object), (len(bpy.data.objects), len(bpy.data.meshes))
    assert bpy.ops.fdda.bind(filepath=str(elbow_files.model)) == {"FINISHED"}
    pose(angle=1.0)
    assert_plays(mesh_object, elbow_files.model)
    assert [(entry.name, entry.path) for entry in mesh_object.fdda.models] == [("elbow", "//elbow.onnx")]
    assert bpy.ops.fdda.unbind() == {"FINISHED"}
    assert modifiers(mesh_object) == before and (len(bpy.data.objects), len(bpy.data.meshes)) == datablocks
    assert len(mesh_object.fdda.models) == 1


def test_bind_with_the_armature_active_or_by_the_name_of_an_object(rig, elbow_files):
    bpy.context.view_layer.objects.active = rig.armature_object
    bpy.ops.fdda.bind(filepath=str(elbow_files.model))
    assert rig.mesh_object.fdda.is_bound
    bpy.ops.fdda.unbind()
    bpy.context.view_layer.objects.active = None
    assert bpy.ops.fdda.bind(object=ELBOW, filepath=str(elbow_files.model)) == {"FINISHED"}
    assert rig.mesh_object.fdda.is_bound
    refused(lambda: bpy.ops.fdda.unbind(object="other"), "no mesh object 'other'")


def test_a_refused_model_does_not_unbind_the_bound_model(active, elbow_files):
    active.data.vertices[0].co.x += 0.1
    refused(lambda: bpy.ops.fdda.bind(filepath=str(elbow_files.model)), "the rest pose of the mesh differs")
    # The bound model does not match the changed mesh either. It stays bound, and the rig is shown.
    assert active.fdda.is_bound and active.fdda.mode == "RIG" and "the rest pose of the mesh" in active.fdda.status


def test_bind_and_unbind_can_be_undone(rig, elbow_files):
    before = modifiers(rig.mesh_object)
    bpy.ops.ed.undo_push(message="start")
    bpy.ops.fdda.bind(filepath=str(elbow_files.model))
    bpy.ops.ed.undo_push(message="bound")
    bpy.ops.fdda.unbind()
    bpy.ops.ed.undo_push(message="unbound")
    bpy.ops.ed.undo()
    pose(angle=1.2)
    assert_plays(bpy.data.objects[ELBOW], elbow_files.model)
    bpy.ops.ed.undo()
    assert modifiers(bpy.data.objects[ELBOW]) == before and not bpy.data.objects[ELBOW].fdda.is_bound
    bpy.ops.ed.redo()
    pose(angle=0.9)
    assert_plays(bpy.data.objects[ELBOW], elbow_files.model)


def test_disabled_operators_say_why(elbow_files):
    refused(bpy.ops.fdda.unbind, "Nothing with a rig is active")
    bpy.ops.wm.open_mainfile(filepath=str(elbow_files.rig))
    for name in ("unbind", "set_mode", "relink", "evaluate", "open_report"):
        refused(getattr(bpy.ops.fdda, name), "No model is bound; bind one first")


def test_set_mode_changes_and_toggles_the_mode(active, elbow_files):
    pose(angle=1.3)
    playing = assert_plays(active, elbow_files.model)
    for mode in ("RIG", "LINEAR"):
        assert bpy.ops.fdda.set_mode(mode=mode) == {"FINISHED"}
        assert active.fdda.mode == mode
        assert np.abs(evaluated_positions(active) - playing).max() > 5e-5
    bpy.ops.fdda.set_mode(mode="RIG")
    bpy.ops.fdda.set_mode()
    assert active.fdda.mode == "FDDA"
    bpy.ops.fdda.set_mode()
    assert active.fdda.mode == "RIG"


def test_measuring_stores_frame_times_and_restores_the_mode(active):
    active.fdda.mode = "LINEAR"
    armature_object = bpy.data.objects[ELBOW_RIG]
    assert measurements.last(measurements.MEASURE, armature_object) is None
    assert bpy.ops.fdda.measure(frames=5) == {"FINISHED"}
    times = measurements.last(measurements.MEASURE, armature_object)
    assert set(times.times) == set(LABELS) and min(map(times.median, LABELS)) > 0
    assert times.constant_bytes == model_files.network_of(active).info.constant_bytes > 0 and not times.is_estimate
    assert active.fdda.mode == "LINEAR" and active.fdda.is_bound and active.fdda.model == "//elbow.onnx"
    bpy.ops.fdda.unbind()
    assert measurements.last(measurements.MEASURE, armature_object) is None


def test_relink_finds_a_model_that_was_moved(elbow_files, tmp_path):
    for path in (elbow_files.bound, elbow_files.model):
        shutil.copy(path, tmp_path)
    (tmp_path / "elbow.onnx").rename(tmp_path / "moved.onnx")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "bound.blend"))
    mesh_object = bpy.data.objects[ELBOW]
    bpy.context.view_layer.update()
    assert "cannot be read" in mesh_object.fdda.status and mesh_object.fdda.mode == "RIG"
    refused(lambda: bpy.ops.fdda.relink(object=ELBOW), "No file was chosen")
    refused(lambda: bpy.ops.fdda.relink(object=ELBOW, filepath=str(tmp_path / "no.onnx")), "cannot be read")
    assert bpy.ops.fdda.relink(object=ELBOW, filepath=str(tmp_path / "moved.onnx")) == {"FINISHED"}
    assert not mesh_object.fdda.status and mesh_object.fdda.mode == "FDDA"
    assert [entry.path for entry in mesh_object.fdda.models] == ["//moved.onnx"]
    pose(angle=1.1)
    assert_plays(mesh_object, tmp_path / "moved.onnx")


def test_confidence_is_that_of_the_evaluated_pose(bound_elbow):
    pose(angle=0.3)
    inside = confidence.partition_confidence(bound_elbow)
    assert sorted(name for name, _ in inside) == ["lower", "upper"]
    assert all(value == pytest.approx(1) for _, value in inside)
    bone = bpy.data.objects[ELBOW_RIG].pose.bones["lower"]
    bone.constraints.remove(bone.constraints[0])
    pose(angle=-2.0)
    outside = confidence.partition_confidence(bound_elbow)
    assert outside[0][1] < 0.99 and outside[0][1] <= outside[-1][1]
    pose(angle=0.3)
    assert confidence.partition_confidence(bound_elbow) == inside


def test_without_a_joint_or_armature_there_is_no_confidence(bound_elbow):
    bpy.data.objects[ELBOW_RIG].data.bones["lower"].name = "forearm"
    assert confidence.partition_confidence(bound_elbow) is None
    bpy.data.objects.remove(bpy.data.objects[ELBOW_RIG])
    assert confidence.partition_confidence(bound_elbow) is None
