# SPDX-License-Identifier: GPL-3.0-or-later
"""Objects that deform a mesh and do not move with its armature are named when it is recorded and bound."""

import bpy
import numpy as np
import pytest

from blend_fixtures.characters import second_armature, stacks
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.recording.run import record
from fdda_addon.runtime.binding import bind

from ..conftest import evaluated_positions
from ..modifiers import build_rig

APART = 1e-3
SENTENCE = (
    "The surface of 'elbow' depends on the place of {}, which no parent or constraint attaches to 'elbow_rig': the "
    "model keeps the place in the recording. If one has to move with the character, parent it to the armature or a "
    "bone; if something else moves it, make that an extra input (--extra-input)."
)


def free_hook() -> bpy.types.Object:
    stacks.hook()
    handle = bpy.data.objects["handle"]
    matrix = handle.matrix_world.copy()
    handle.parent, handle.matrix_world = None, matrix
    return handle


def hook_of_another_armature() -> bpy.types.Object:
    free_hook().parent = armature_object = second_armature.add_unlocked_armature()
    return armature_object


def hook_on_another_armature() -> bpy.types.Object:
    stacks.hook()
    armature_object = second_armature.add_unlocked_armature()
    bpy.data.objects["elbow"].modifiers["Hook"].object = armature_object
    return armature_object


def hook_on_the_rig() -> bpy.types.Object:
    stacks.hook()
    return bpy.data.objects["handle"]


def hook_that_copies_a_bone() -> bpy.types.Object:
    handle = free_hook()
    copy = handle.constraints.new("COPY_LOCATION")
    copy.target, copy.subtarget = bpy.data.objects["elbow_rig"], "lower"
    return handle


CASES = {
    free_hook: "the object 'handle'",
    hook_of_another_armature: "the 2 objects 'handle' and 'muscle_rig'",
    hook_on_another_armature: "the object 'muscle_rig'",
    hook_on_the_rig: "",
    hook_that_copies_a_bone: "",
}


@pytest.mark.parametrize("build", CASES, ids=lambda build: build.__name__)
def test_objects_that_do_not_move_with_the_armature_are_named(build, loose_model, tmp_path):
    moved = []
    rig = build_rig(lambda: moved.append(build()))
    bpy.context.view_layer.update()
    sentences = [SENTENCE.format(CASES[build])] if CASES[build] else []
    steps = list(record(rig, tmp_path / "recording", RecordingSettings(poses=4, influence_poses=1)))
    assert [step.note for step in steps if "disk" not in step.note and step.note] == sentences
    if sentences:
        still = evaluated_positions(rig.mesh_object)
        moved[0].location.z += 0.1
        bpy.context.view_layer.update()
        assert np.abs(evaluated_positions(rig.mesh_object) - still).max() > APART, "it is a case"
    assert bind(rig, loose_model) == "".join(sentences)


def test_an_object_that_controls_move_is_not_named(tmp_path):
    rig = build_rig(free_hook)
    controls = tuple(f"object:handle/location[{axis}]=-0.1:0.1" for axis in range(3))
    settings = RecordingSettings(poses=4, influence_poses=1, extra_inputs=controls)
    steps = list(record(rig, tmp_path / "recording", settings))
    assert not [step.note for step in steps if "disk" not in step.note and step.note]
