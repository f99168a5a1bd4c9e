# SPDX-License-Identifier: GPL-3.0-or-later
"""The operators of the section Rig, without a window: the sample arm, the measured speed, and their character."""

import bpy
import pytest

from fdda_addon.jobs import job
from fdda_addon.timing import measurements
from fdda_addon.timing.benchmark import BONES, FDDA, LINEAR, RIG

from ..conftest import ELBOW
from ..scene_state import assert_same_state, scene_state


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
