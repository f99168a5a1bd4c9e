# SPDX-License-Identifier: GPL-3.0-or-later
"""Playback after the character is edited, renamed or partly deleted."""

import bpy
import numpy as np

from ..conftest import ELBOW, ELBOW_RIG, assert_plays, evaluated_positions, pose, predicted_positions


def test_edit_mode(bound_elbow, elbow_files):
    bpy.context.view_layer.objects.active = bound_elbow
    bpy.ops.object.mode_set(mode="EDIT")
    pose(angle=1.5)
    in_edit_mode = evaluated_positions(bound_elbow)
    assert np.abs(in_edit_mode - predicted_positions(bound_elbow, elbow_files.model)).max() < 1e-5
    bpy.ops.object.mode_set(mode="OBJECT")
    assert np.array_equal(assert_plays(bound_elbow, elbow_files.model), in_edit_mode)


def test_renaming(bound_elbow, elbow_files):
    armature_object = bpy.data.objects[ELBOW_RIG]
    bound_elbow.name, armature_object.name = "other", "other rig"
    pose("other rig", angle=1.3)
    assert_plays(bound_elbow, elbow_files.model)


def test_deleting_the_armature(bound_elbow, capsys):
    bpy.data.objects.remove(bpy.data.objects[ELBOW_RIG])
    bpy.context.view_layer.update()
    bpy.context.scene.frame_set(7)
    bpy.context.scene.frame_set(8)
    assert bound_elbow.fdda.mode == "RIG"
    assert "'elbow' has no Armature modifier with an armature any more" in bound_elbow.fdda.status
    assert capsys.readouterr().out.count("switched off") == 1
    assert [m.show_viewport for m in bound_elbow.modifiers] == [True, True, False, False]


def test_deleting_the_armature_comes_back_with_undo(bound_elbow, elbow_files):
    pose(angle=1.0)
    bpy.ops.ed.undo_push(message="posed")
    bpy.data.objects.remove(bpy.data.objects[ELBOW_RIG])
    bpy.context.view_layer.update()
    bpy.ops.ed.undo_push(message="deleted")
    bpy.ops.ed.undo()
    pose(angle=1.4)
    assert_plays(bpy.data.objects[ELBOW], elbow_files.model)
