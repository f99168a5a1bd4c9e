# SPDX-License-Identifier: GPL-3.0-or-later
"""The operators of the sections Rig and Model, without a window: add, measure, bind, switch, find a file, unbind."""

import shutil

import bpy
import numpy as np
import pytest

from fdda_addon.jobs import job
from fdda_addon.runtime import confidence
from fdda_addon.timing import measurements
from fdda_addon.timing.benchmark import BONES, FDDA, LABELS, LINEAR, RIG

from ..conftest import ELBOW, ELBOW_RIG, assert_plays, evaluated_positions, pose
from ..refusals import refused
from ..scene_state import assert_same_state, scene_state


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
    assert not times.is_estimate
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


class TestSampleArm:
    def test_adding_the_arm_hides_the_default_cube_and_frames_the_arm(self):
        bpy.ops.wm.read_factory_settings()
        assert bpy.ops.fdda.add_sample_arm(density="1") == {"FINISHED"}
        assert not bpy.data.objects["Cube"].visible_get() and bpy.data.objects["Cube"].hide_render
        views = [a.spaces.active.region_3d for s in bpy.data.screens for a in s.areas if a.type == "VIEW_3D"]
        assert views
        for view in views:
            assert 0.2 < view.view_location.x < 0.6 and 0.5 < view.view_distance < 1.5

    def test_the_arm_is_added_to_the_current_scene(self):
        bpy.ops.mesh.primitive_cube_add()
        cube = bpy.context.active_object
        cube.location.x = 3
        bpy.context.view_layer.update()
        assert bpy.ops.fdda.add_sample_arm() == {"FINISHED"}
        arm = bpy.context.active_object
        assert arm.name == "arm" and len(arm.data.vertices) == 9960 and arm.select_get()
        assert cube.visible_get(), "somebody has moved it"
        assert cube.name in bpy.context.scene.objects and not cube.select_get()
        assert bpy.context.scene.frame_end == 250

    def test_a_second_arm_has_a_separate_rig(self):
        bpy.ops.fdda.add_sample_arm(density="1")
        bpy.context.scene.frame_end = 77
        bpy.ops.fdda.add_sample_arm(density="1")
        second = bpy.context.active_object
        assert second.name == "arm.001" and second.modifiers["Armature"].object.name == "arm_rig.001"
        driver = second.data.shape_keys.animation_data.drivers[0].driver
        assert driver.variables[0].targets[0].id.name == "arm_rig.001"
        assert bpy.context.scene.frame_end == 77, "the range belongs to whoever animates already"

    def test_adding_the_arm_can_be_undone(self):
        bpy.ops.ed.undo_push()
        bpy.ops.fdda.add_sample_arm(density="1")
        bpy.ops.ed.undo_push()
        bpy.ops.ed.undo()
        assert "arm" not in bpy.data.objects and "arm_rig" not in bpy.data.objects

    def test_adding_the_arm_in_edit_mode_is_refused(self, saved):
        bpy.ops.object.mode_set(mode="EDIT")
        with pytest.raises(RuntimeError, match="Objects can only be added in Object Mode"):
            bpy.ops.fdda.add_sample_arm(density="1")

    def test_measuring_restores_the_scene_and_stores_the_cost(self, saved):
        before = scene_state(saved)
        assert bpy.ops.fdda.measure(frames=5) == {"FINISHED"}
        assert_same_state(before, scene_state(saved))
        times = measurements.last(measurements.MEASURE, saved.armature_object)
        assert [(mesh.name, mesh.has_model) for mesh in times.meshes] == [(ELBOW, True)]
        assert times.median(RIG) > times.median(LINEAR) > times.median(BONES) > 0
        assert times.median(FDDA) > times.median(BONES) and times.is_estimate
        assert job.state_of("measure").outcome.endswith(times.sentence) and "(estimate)" in times.sentence


class TestUsedRig:
    def test_operators_without_an_active_object_are_refused(self):
        with pytest.raises(RuntimeError, match="Nothing with a rig is active; select the mesh of a character"):
            bpy.ops.fdda.record()

    def test_an_active_mesh_without_a_rig_is_refused(self, saved):
        bpy.ops.mesh.primitive_cube_add()
        with pytest.raises(RuntimeError, match="'Cube' has no Armature modifier with an armature"):
            bpy.ops.fdda.measure(frames=5)
        assert bpy.ops.fdda.measure(object=ELBOW, frames=5) == {"FINISHED"}

    def test_an_unknown_object_name_is_refused(self, saved):
        with pytest.raises(RuntimeError, match="The scene has no mesh object 'none'; its mesh objects: 'elbow'"):
            bpy.ops.fdda.record(object="none")

    def test_of_two_meshes_the_selected_or_else_the_chosen_mesh_is_used(self, saved):
        other = saved.mesh_object.copy()
        other.data = saved.mesh_object.data.copy()
        bpy.context.scene.collection.objects.link(other)
        for mesh_object in (saved.mesh_object, other):
            mesh_object.select_set(False)
        bpy.context.view_layer.objects.active = saved.armature_object
        assert bpy.ops.fdda.measure(frames=5) == {"FINISHED"}
        assert job.state_of("measure").subject == saved.mesh_object.session_uid
        bpy.context.window_manager.fdda.mesh = other.name
        assert bpy.ops.fdda.measure(frames=5) == {"FINISHED"}
        assert job.state_of("measure").subject == other.session_uid
        saved.mesh_object.select_set(True)
        assert bpy.ops.fdda.measure(frames=5) == {"FINISHED"}
        assert job.state_of("measure").subject == saved.mesh_object.session_uid


def test_the_arm_is_in_the_menu_while_the_addon_is_enabled():
    import fdda_addon

    def entries() -> list[str]:
        return [draw.__module__ for draw in bpy.types.VIEW3D_MT_armature_add._dyn_ui_initialize()]

    assert entries().count("fdda_addon.operators.rig") == 1
    fdda_addon.unregister()
    assert "fdda_addon.operators.rig" not in entries()
    fdda_addon.register()
