# SPDX-License-Identifier: GPL-3.0-or-later
"""A bound mesh shows the output of its model for the evaluated pose, from any source of poses."""

import shutil
from itertools import pairwise

import bpy
import numpy as np
import pytest

from fdda_addon.runtime import playback_modifier
from fdda_addon.runtime.binding import bind, unbind
from fdda_addon.scene.scene_rig import find_rig

from .conftest import ELBOW, ELBOW_RIG, assert_plays, evaluated, pose


def test_opened_file_plays(bound, elbow):
    assert_plays(bound, elbow.model)


def test_frame_set(bound, elbow):
    frames = [assert_plays(bound, elbow.model) for f in (5, 12, 25) if not bpy.context.scene.frame_set(f)]
    assert np.abs(frames[0] - frames[1]).max() > 1e-3


def test_posing(bound, elbow):
    pose(angle=0.4)
    first = assert_plays(bound, elbow.model)
    pose(angle=1.6)
    assert np.abs(assert_plays(bound, elbow.model) - first).max() > 1e-2


def test_each_bone_of_a_chain(bound, elbow):
    """The driver depends on the last bone only, which Blender evaluates after its parents, also with an IK solver."""
    buffer = playback_modifier.buffer_of(playback_modifier.find_modifier(bound))
    variables = buffer.animation_data.drivers[0].driver.variables
    assert {v.targets[0].bone_target for v in variables if v.type == "TRANSFORMS"} == {"", "lower"}
    shown = [assert_plays(bound, elbow.model)]
    for angle, bone in ((0.7, "upper"), (0.5, "lower"), (-0.3, "upper")):
        pose(angle=angle, bone=bone)
        shown.append(assert_plays(bound, elbow.model))
    target = bpy.data.objects.new("target", None)
    bpy.context.scene.collection.objects.link(target)
    constraint = bpy.data.objects[ELBOW_RIG].pose.bones["lower"].constraints.new("IK")
    constraint.target, constraint.chain_count = target, 2
    for place in ((0.3, 0.2, 0.4), (-0.2, 0.4, 0.1)):
        target.location = place
        bpy.context.view_layer.update()
        shown.append(assert_plays(bound, elbow.model))
    assert all(np.abs(after - before).max() > 1e-2 for before, after in pairwise(shown))


def test_playback_follows_a_mesh_that_moves_away_from_its_armature(bound, elbow):
    pose(angle=0.8)
    before = assert_plays(bound, elbow.model)
    bound.location = (0.1, 0.2, 0.3)
    bpy.context.view_layer.update()
    assert np.abs(assert_plays(bound, elbow.model) - before).max() > 0.05


def test_playing_differs_from_the_rig(bound, elbow):
    pose(angle=1.9)
    playing = evaluated(bound)
    bound.fdda.mode = "RIG"
    rig = evaluated(bound)
    bound.fdda.mode = "LINEAR"
    linear = evaluated(bound)
    errors = [np.linalg.norm(positions - rig, axis=1).mean() for positions in (playing, linear)]
    assert 0 < errors[0] < errors[1] / 3


def test_rig_mode_shows_the_rig_again(bound, elbow):
    pose(angle=1.2)
    bound.fdda.mode = "RIG"
    assert [m.show_viewport for m in bound.modifiers] == [True, True, False]
    true = evaluated(bound)
    bound.fdda.mode = "FDDA"
    assert [m.show_viewport for m in bound.modifiers] == [False, False, True]
    assert_plays(bound, elbow.model)
    bound.fdda.mode = "RIG"
    assert np.array_equal(evaluated(bound), true)


def test_linear_skinning_is_the_armature_modifier(bound):
    pose(angle=1.4)
    bound.fdda.mode = "LINEAR"
    linear = evaluated(bound)
    bound.fdda.mode = "RIG"
    bound.modifiers["CorrectiveSmooth"].show_viewport = False
    assert np.abs(evaluated(bound) - linear).max() < 1e-5


def test_strength_blends(bound, elbow):
    pose(angle=1.4)
    playing = assert_plays(bound, elbow.model)
    bound.fdda.strength = 0
    linear = evaluated(bound)
    bound.fdda.strength = 0.25
    assert np.abs(evaluated(bound) - (0.75 * linear + 0.25 * playing)).max() < 1e-6
    assert np.abs(playing - linear).max() > 1e-3


def test_save_and_reload(bound, elbow):
    pose(angle=0.9)
    path = elbow.bound.with_name("saved.blend")
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    bpy.ops.wm.open_mainfile(filepath=str(path))
    reloaded = bpy.data.objects[ELBOW]
    assert_plays(reloaded, elbow.model)
    pose(angle=1.7)
    assert_plays(reloaded, elbow.model)


def test_undo_and_redo(bound, elbow):
    bpy.ops.ed.undo_push(message="start")
    pose(angle=0.5)
    bpy.ops.ed.undo_push(message="first")
    first = evaluated(bound)
    pose(angle=1.8)
    bpy.ops.ed.undo_push(message="second")
    second = evaluated(bound)
    bpy.ops.ed.undo()
    assert bpy.data.objects[ELBOW_RIG].pose.bones["lower"].rotation_euler[0] == pytest.approx(0.5)
    assert np.array_equal(assert_plays(bpy.data.objects[ELBOW], elbow.model), first)
    bpy.ops.ed.redo()
    assert np.array_equal(assert_plays(bpy.data.objects[ELBOW], elbow.model), second)
    pose(angle=1.1)
    assert_plays(bpy.data.objects[ELBOW], elbow.model)


def test_undo_of_bind(rig, elbow):
    bpy.ops.ed.undo_push(message="start")
    bind(rig, elbow.model)
    bpy.context.view_layer.update()
    bpy.ops.ed.undo_push(message="bound")
    bpy.ops.ed.undo()
    mesh_object = bpy.data.objects[ELBOW]
    assert not mesh_object.fdda.is_bound
    pose(angle=1.0)
    assert all(m.show_viewport for m in mesh_object.modifiers)
    bpy.ops.ed.redo()
    pose(angle=1.2)
    assert_plays(bpy.data.objects[ELBOW], elbow.model)


@pytest.mark.parametrize("linked", [False, True], ids=["own mesh", "shared mesh"])
def test_two_characters_play_different_poses(bound, elbow, linked):
    armature_object = bpy.data.objects[ELBOW_RIG]
    second, second_rig = bound.copy(), armature_object.copy()
    if not linked:
        second.data = bound.data.copy()
    for new in (second, second_rig):
        bpy.context.scene.collection.objects.link(new)
    second.modifiers["Armature"].object = second_rig
    second_rig.animation_data_clear()
    pose(angle=0.3)
    pose(second_rig.name, angle=1.9)
    first_positions, second_positions = assert_plays(bound, elbow.model), assert_plays(second, elbow.model)
    assert np.abs(first_positions - second_positions).max() > 0.05
    pose(angle=1.5)
    assert np.array_equal(assert_plays(second, elbow.model), second_positions)
    assert np.abs(assert_plays(bound, elbow.model) - first_positions).max() > 0.05


def test_objects_with_different_transforms(rig, elbow):
    """The transform between mesh and armature changes after binding. Playback is compared with Blender's skinning."""
    bind(rig, elbow.model)
    rig.mesh_object.location = (0.3, -0.2, 0.1)
    rig.mesh_object.rotation_euler = (0.2, 0.4, -0.3)
    rig.armature_object.location = (-0.5, 0.1, 0.9)
    rig.armature_object.scale = (1.2, 1.2, 1.2)
    pose(angle=1.3)
    assert_plays(rig.mesh_object, elbow.model)
    rig.mesh_object.fdda.mode = "LINEAR"
    linear = evaluated(rig.mesh_object)
    unbind(rig.mesh_object)
    rig.mesh_object.modifiers["CorrectiveSmooth"].show_viewport = False
    assert np.abs(evaluated(rig.mesh_object) - linear).max() < 1e-5


def test_missing_model_is_reported(bound, elbow, tmp_path):
    path = shutil.copy(elbow.bound, tmp_path / "alone.blend")
    bpy.ops.wm.open_mainfile(filepath=str(path))
    mesh_object = bpy.data.objects[ELBOW]
    bpy.context.view_layer.update()
    assert mesh_object.fdda.mode == "RIG"
    assert "cannot be read" in mesh_object.fdda.status or "outside the folder" in mesh_object.fdda.status


def test_path_out_of_the_folder_is_not_followed(bound, elbow, tmp_path):
    bound.fdda.model = str(elbow.model)
    path = tmp_path / "elsewhere.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True)
    from fdda_addon.runtime import model_files

    model_files._chosen_paths.clear()
    bpy.ops.wm.open_mainfile(filepath=str(path))
    bpy.context.view_layer.update()
    assert "outside the folder of 'elsewhere.blend'" in bpy.data.objects[ELBOW].fdda.status


def test_unbind_leaves_nothing(rig, elbow):
    def count():
        return len(bpy.data.objects), len(bpy.data.meshes), [m.name for m in rig.mesh_object.modifiers]

    before = count()
    bind(rig, elbow.model)
    pose(angle=1.0)
    unbind(rig.mesh_object)
    assert count() == before
    assert all(m.show_viewport and m.show_render for m in rig.mesh_object.modifiers)


def test_binding_twice(bound, elbow):
    bind(find_rig(), elbow.model)
    pose(angle=1.0)
    assert_plays(bound, elbow.model)
    assert sum(m.type == "NODES" for m in bound.modifiers) == 1


def test_hidden_armature(bound, elbow):
    bpy.data.objects[ELBOW_RIG].hide_viewport = True
    pose(angle=0.2)
    first = assert_plays(bound, elbow.model)
    pose(angle=1.4)
    assert np.abs(assert_plays(bound, elbow.model) - first).max() > 0.02


def test_modifiers_after_the_rig_stay(bound, elbow):
    bound.modifiers.new("Subdivision", "SUBSURF")
    pose(angle=1.0)
    assert len(evaluated(bound)) > len(bound.data.vertices)
    bound.modifiers["Subdivision"].show_viewport = False
    assert_plays(bound, elbow.model)
