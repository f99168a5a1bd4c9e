# SPDX-License-Identifier: GPL-3.0-or-later
"""Playback after the character is edited, renamed or partly deleted."""

import bpy
import numpy as np

from fdda_addon.runtime import playback_modifier

from .conftest import ELBOW, ELBOW_RIG, assert_plays, evaluated, pose, predicted


def test_edit_mode(bound, elbow):
    bpy.context.view_layer.objects.active = bound
    bpy.ops.object.mode_set(mode="EDIT")
    pose(angle=1.5)
    in_edit_mode = evaluated(bound)
    assert np.abs(in_edit_mode - predicted(bound, elbow.model)).max() < 1e-5
    bpy.ops.object.mode_set(mode="OBJECT")
    assert np.array_equal(assert_plays(bound, elbow.model), in_edit_mode)


def test_edit_mode_that_changes_the_topology(bound, elbow, capsys):
    bpy.context.view_layer.objects.active = bound
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.mesh.subdivide()
    bpy.ops.object.mode_set(mode="OBJECT")
    pose(angle=1.0)
    pose(angle=1.2)
    assert bound.fdda.mode == "RIG"
    assert f"has {len(bound.data.vertices)} vertices and its model was trained for" in bound.fdda.status
    assert capsys.readouterr().out.count("switched off") == 1


def test_renaming(bound, elbow):
    armature_object = bpy.data.objects[ELBOW_RIG]
    bound.name, armature_object.name = "other", "other rig"
    pose("other rig", angle=1.3)
    assert_plays(bound, elbow.model)


def test_deleting_the_mesh(bound):
    bpy.data.objects.remove(bound)
    pose(angle=1.3)
    bpy.context.scene.frame_set(7)


def test_deleting_the_armature(bound, capsys):
    bpy.data.objects.remove(bpy.data.objects[ELBOW_RIG])
    bpy.context.view_layer.update()
    bpy.context.scene.frame_set(7)
    bpy.context.scene.frame_set(8)
    assert bound.fdda.mode == "RIG"
    assert "armature of 'elbow' is gone" in bound.fdda.status
    assert capsys.readouterr().out.count("switched off") == 1
    assert [m.show_viewport for m in bound.modifiers] == [True, True, False]


def test_deleting_the_armature_comes_back_with_undo(bound, elbow):
    pose(angle=1.0)
    bpy.ops.ed.undo_push(message="posed")
    bpy.data.objects.remove(bpy.data.objects[ELBOW_RIG])
    bpy.context.view_layer.update()
    bpy.ops.ed.undo_push(message="deleted")
    bpy.ops.ed.undo()
    pose(angle=1.4)
    assert_plays(bpy.data.objects[ELBOW], elbow.model)


def test_renamed_bone_is_reported(bound, elbow):
    bpy.data.objects[ELBOW_RIG].data.bones["lower"].name = "forearm"
    bound.fdda.mode = "RIG"
    path = elbow.bound.with_name("renamed.blend")
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    bpy.ops.wm.open_mainfile(filepath=str(path))
    bpy.data.objects[ELBOW].fdda.mode = "FDDA"
    bpy.context.view_layer.update()
    assert "lacks the joint 'lower'" in bpy.data.objects[ELBOW].fdda.status


def test_a_bone_that_is_added(bound, elbow):
    armature_object = bpy.data.objects[ELBOW_RIG]
    bpy.context.view_layer.objects.active = armature_object
    bpy.ops.object.mode_set(mode="EDIT")
    bone = armature_object.data.edit_bones.new("a_prop")
    bone.tail = (0, 0, 0.1)
    bpy.ops.object.mode_set(mode="OBJECT")
    pose(angle=0.8)
    assert_plays(bound, elbow.model)


def test_removed_modifier_is_reported(bound):
    bound.modifiers.remove(playback_modifier.find_modifier(bound))
    pose(angle=1.0)
    bound.fdda.mode = "LINEAR"
    assert bound.fdda.mode == "RIG"
    assert "removed; bind the model again" in bound.fdda.status
