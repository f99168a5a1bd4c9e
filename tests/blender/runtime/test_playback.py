# SPDX-License-Identifier: GPL-3.0-or-later
"""A bound mesh shows the output of its model for the evaluated pose, from any source of poses and after any edit."""

import sys
from itertools import pairwise

import bpy
import numpy as np
import pytest

from benchmarks.stress_playback import MAX_DIFFERENCE_M, OPERATION_WEIGHTS, PlaybackStress
from fdda_addon.runtime import playback_modifier
from fdda_addon.runtime.binding import bind, unbind
from fdda_addon.runtime.player import ModelInputs, Player
from fdda_addon.runtime.player_batch import PlayedPose
from fdda_addon.scene.control_reader import ControlReader

from ..conftest import ELBOW, ELBOW_RIG, assert_plays, evaluated_positions, pose, predicted_positions


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


def test_a_player_is_locked_while_it_reads_the_pose(bound_elbow, monkeypatch):
    """A render and the viewport may evaluate the same character on two threads."""
    read_inputs, lock_states = Player.read_inputs, []

    def record_lock(player: Player, *evaluated_datablocks: object) -> ModelInputs:
        lock_states.append(player.lock.locked())
        return read_inputs(player, *evaluated_datablocks)

    monkeypatch.setattr(Player, "read_inputs", record_lock)
    pose(angle=0.5)
    assert lock_states and all(lock_states)


def test_a_changed_control_runs_the_model_in_an_unchanged_pose(bound_elbow, monkeypatch):
    """An unchanged pose runs the model again only if a control has changed."""
    values, played_controls = [], []

    def record_controls(pose: PlayedPose) -> None:
        played_controls.append(pose.inputs.controls.tolist())
        pose.is_outdated = False

    monkeypatch.setattr(ControlReader, "values", lambda *_: np.array(values, np.float32))
    monkeypatch.setattr(PlayedPose, "run", record_controls)
    for value in (1.0, 1.0, 2.0):
        values[:] = [value]
        bpy.data.objects[ELBOW_RIG].update_tag(refresh={"DATA"})
        bpy.context.view_layer.update()
    assert played_controls == [[1.0], [2.0]]


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_random_operations_leave_correct_playback_and_no_memory(bound_elbow, elbow_files, tmp_path, seed):
    bpy.context.scene.frame_set(1)
    outcome = PlaybackStress(bound_elbow, {"": elbow_files.model}, 6, tmp_path, seed).run(250)
    assert outcome.largest_difference < MAX_DIFFERENCE_M, outcome.worst_case
    assert outcome.compared_count > 600 and len(outcome.operations) == len(OPERATION_WEIGHTS)
    # What was allocated once stays; a character more or less is below a megabyte.
    half = len(outcome.memory_mb) // 2
    # Only Linux says what a process holds.
    assert sys.platform != "linux" or outcome.memory_mb[-1] - outcome.memory_mb[half] < 10
