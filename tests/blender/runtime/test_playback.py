# SPDX-License-Identifier: GPL-3.0-or-later
"""A bound mesh shows the output of its model for the evaluated pose, from any source of poses."""

from itertools import pairwise

import bpy
import numpy as np
import pytest

from fdda_addon.runtime import playback_modifier
from fdda_addon.runtime.binding import bind, unbind

from ..conftest import ELBOW_RIG, assert_plays, evaluated_positions, pose


def test_each_bone_of_a_chain(bound_elbow, elbow_files):
    """The driver depends on the last bone only, which Blender evaluates after its parents, also with an IK solver."""
    buffer = playback_modifier.buffer_of(playback_modifier.find_modifier(bound_elbow))
    variables = buffer.animation_data.drivers[0].driver.variables
    assert {v.targets[0].bone_target for v in variables if v.type == "TRANSFORMS"} == {"", "lower"}
    shown = [assert_plays(bound_elbow, elbow_files.model)]
    for angle, bone in ((0.7, "upper"), (0.5, "lower"), (-0.3, "upper")):
        pose(angle=angle, bone=bone)
        shown.append(assert_plays(bound_elbow, elbow_files.model))
    target = bpy.data.objects.new("target", None)
    bpy.context.scene.collection.objects.link(target)
    constraint = bpy.data.objects[ELBOW_RIG].pose.bones["lower"].constraints.new("IK")
    constraint.target, constraint.chain_count = target, 2
    for place in ((0.3, 0.2, 0.4), (-0.2, 0.4, 0.1)):
        target.location = place
        bpy.context.view_layer.update()
        shown.append(assert_plays(bound_elbow, elbow_files.model))
    assert all(np.abs(after - before).max() > 1e-2 for before, after in pairwise(shown))


def test_modes_and_strength_show_rig_linear_skinning_and_model(bound_elbow, elbow_files):
    def shown_modifiers():
        return [modifier.show_viewport for modifier in bound_elbow.modifiers]

    pose(angle=1.9)
    playing = assert_plays(bound_elbow, elbow_files.model)
    assert shown_modifiers() == [False, False, True, True]
    bound_elbow.fdda.mode = "RIG"
    assert shown_modifiers() == [True, True, False, False]
    rig = evaluated_positions(bound_elbow)
    bound_elbow.fdda.mode = "LINEAR"
    linear = evaluated_positions(bound_elbow)
    errors = [np.linalg.norm(positions - rig, axis=1).mean() for positions in (playing, linear)]
    assert 0 < errors[0] < errors[1] / 3
    bound_elbow.fdda.mode = "FDDA"
    assert shown_modifiers() == [False, False, True, True]
    assert_plays(bound_elbow, elbow_files.model)
    for strength in (0, 0.25):
        bound_elbow.fdda.strength = strength
        expected = (1 - strength) * linear + strength * playing
        assert np.abs(evaluated_positions(bound_elbow) - expected).max() < 1e-6
    assert np.abs(playing - linear).max() > 1e-3
    bound_elbow.fdda.mode = "RIG"
    assert np.array_equal(evaluated_positions(bound_elbow), rig)
    bound_elbow.modifiers["CorrectiveSmooth"].show_viewport = False
    assert np.abs(evaluated_positions(bound_elbow) - linear).max() < 1e-5


@pytest.mark.parametrize("linked", [False, True], ids=["own mesh", "shared mesh"])
def test_two_characters_play_different_poses(bound_elbow, elbow_files, linked):
    armature_object = bpy.data.objects[ELBOW_RIG]
    second, second_rig = bound_elbow.copy(), armature_object.copy()
    if not linked:
        second.data = bound_elbow.data.copy()
    for new in (second, second_rig):
        bpy.context.scene.collection.objects.link(new)
    second.modifiers["Armature"].object = second_rig
    second_rig.animation_data_clear()
    pose(angle=0.3)
    pose(second_rig.name, angle=1.9)
    first_positions, second_positions = (
        assert_plays(bound_elbow, elbow_files.model),
        assert_plays(second, elbow_files.model),
    )
    assert np.abs(first_positions - second_positions).max() > 0.05
    pose(angle=1.5)
    assert np.array_equal(assert_plays(second, elbow_files.model), second_positions)
    assert np.abs(assert_plays(bound_elbow, elbow_files.model) - first_positions).max() > 0.05


def test_objects_with_different_transforms(rig, elbow_files):
    """The transform between mesh and armature changes after binding. Playback is compared with Blender's skinning."""
    bind(rig, elbow_files.model)
    pose(angle=1.3)
    before = assert_plays(rig.mesh_object, elbow_files.model)
    rig.mesh_object.location = (0.3, -0.2, 0.1)
    rig.mesh_object.rotation_euler = (0.2, 0.4, -0.3)
    rig.armature_object.location = (-0.5, 0.1, 0.9)
    rig.armature_object.scale = (1.2, 1.2, 1.2)
    pose(angle=1.3)
    assert np.abs(assert_plays(rig.mesh_object, elbow_files.model) - before).max() > 0.05
    rig.mesh_object.fdda.mode = "LINEAR"
    linear = evaluated_positions(rig.mesh_object)
    unbind(rig.mesh_object)
    rig.mesh_object.modifiers["CorrectiveSmooth"].show_viewport = False
    assert np.abs(evaluated_positions(rig.mesh_object) - linear).max() < 1e-5


def test_hidden_armature(bound_elbow, elbow_files):
    bpy.data.objects[ELBOW_RIG].hide_viewport = True
    pose(angle=0.2)
    first = assert_plays(bound_elbow, elbow_files.model)
    pose(angle=1.4)
    assert np.abs(assert_plays(bound_elbow, elbow_files.model) - first).max() > 0.02
