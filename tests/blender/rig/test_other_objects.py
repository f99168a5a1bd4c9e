# SPDX-License-Identifier: GPL-3.0-or-later
"""Objects and second armatures that deform a mesh are inputs of the model, or are named."""

import bpy
import numpy as np
import pytest
from mathutils import Euler

from blend_fixtures.characters import second_armature, stacks
from fdda_addon.core.errors import RigError
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.evaluation.run import evaluate
from fdda_addon.evaluation.settings import EvaluationSettings
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.recording.rig_check import check_recordable_rig
from fdda_addon.recording.run import record
from fdda_addon.rig.reading import PoseEvaluator
from fdda_addon.runtime.binding import bind

from ..conftest import evaluated_positions
from ..modifiers import FEW_POSES, build_rig
from ..scene_state import assert_same_state, drain, scene_state

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


FOLLOWS = (
    "'elbow' follows the bone '{}' of a second armature, 'muscle_rig', which can {}, but is no input of the model; {}, "
    "or join the armatures."
)

EULER, LOCKED = "set its rotation mode to XYZ Euler", "lock its {} (or add {} in local space)"

ALL = FOLLOWS.format(
    "muscle",
    "rotate and move and scale",
    f"{EULER} and {LOCKED.format('location and scale', 'Limit Location and Limit Scale')}",
)

READS = 'pose.bones["muscle"].rotation_quaternion[1]'

SENTENCES = {
    second_armature.quaternion: FOLLOWS.format("muscle", "rotate", EULER),
    second_armature.axis_angle: FOLLOWS.format("muscle", "rotate", EULER),
    second_armature.free_location: FOLLOWS.format("muscle", "move", LOCKED.format("location", "Limit Location")),
    second_armature.free_scale: FOLLOWS.format("muscle", "scale", LOCKED.format("scale", "Limit Scale")),
    second_armature.free_root: FOLLOWS.format("root", "rotate", EULER),
    second_armature.hook_on_a_bone: ALL,
    second_armature.hook_that_copies_a_bone: ALL,
    second_armature.lattice_on_a_bone: ALL,
    second_armature.driver_of_a_bone: ALL,
    second_armature.driver_of_a_channel: (
        f"A driver of 'elbow' reads '{READS}' of a second armature, 'muscle_rig', which is no input of the model; name "
        f"it as a control with a range (--extra-input 'object:muscle_rig/{READS}=LOW:HIGH'), or lock it."
    ),
}  # fmt: skip


def move(bone: bpy.types.PoseBone) -> None:
    """Change all unlocked transform channels of a bone."""
    turned = Euler((0.0 if all(bone.lock_rotation) else 0.5, 0.0, 0.0))
    bone.rotation_quaternion = turned.to_quaternion()
    axis, angle = turned.to_quaternion().to_axis_angle()
    bone.rotation_axis_angle = (angle, *axis)
    for axis in range(3):
        bone.location[axis] = 0.0 if bone.lock_location[axis] else 0.02
        bone.scale[axis] = 1.0 if bone.lock_scale[axis] else 1.5
    bpy.context.view_layer.update()


@pytest.mark.parametrize("build", SENTENCES, ids=lambda build: build.__name__)
def test_a_bone_that_is_no_input_of_the_model_is_named(build, loose_model, tmp_path):
    rig = build_rig(build)
    before = scene_state(rig)
    assert SENTENCES[build] in check_recordable_rig(rig).problems
    with pytest.raises(RigError) as error:
        drain(record(rig, tmp_path / "recording", FEW_POSES))
    assert str(error.value) == SENTENCES[build]
    # This model is not told of Euler angles either.
    with pytest.raises(RigError, match=r" of a second armature, 'muscle_rig', .*is no input of the model; "):
        drain(evaluate(rig, loose_model, EvaluationSettings(poses=2)))
    with pytest.raises(RigError, match=r" of a second armature, 'muscle_rig', .*is no input of the model; "):
        bind(rig, loose_model)
    assert_same_state(before, scene_state(rig))
    still = evaluated_positions(rig.mesh_object)
    move(bpy.data.objects["muscle_rig"].pose.bones["root" if build is second_armature.free_root else "muscle"])
    assert np.linalg.norm(evaluated_positions(rig.mesh_object) - still, axis=1).max() > APART, "it is a case"


EXPECTED = {
    second_armature.two_armatures: {"rotation_euler[0]", "rotation_euler[2]"},
    second_armature.limited_location: {"rotation_euler[0]", "rotation_euler[2]", "location[2]"},
    second_armature.copied_from_the_first: set(),
}


@pytest.mark.parametrize("build", EXPECTED, ids=lambda build: build.__name__)
def test_a_bone_that_is_an_input_of_the_model_is_recorded(build, tmp_path):
    rig = build_rig(build)
    assert check_recordable_rig(rig).problems == ()
    drain(record(rig, tmp_path / "recording", RecordingSettings(poses=6, influence_poses=1)))
    recording = read_recording(tmp_path / "recording")
    names = {control.name for control in recording.rig.controls}
    assert names == {f'object:muscle_rig/pose.bones["muscle"].{path}' for path in EXPECTED[build]}
    # Moving it changes what the model is told, as it changes the surface.
    evaluator = PoseEvaluator(rig, recording.rig)
    pose, shown, controls = evaluator.evaluate()
    if build is second_armature.copied_from_the_first:
        bone = rig.armature_object.pose.bones["handle"]
    else:
        bone = second_armature.muscle_bone()
    for axis in (0, 2):
        bone.rotation_euler[axis] = 0.3
        bone.location[axis] = 0.0 if bone.lock_location[axis] else 0.02
    bpy.context.view_layer.update()
    moved_pose, moved, moved_controls = evaluator.evaluate()
    assert np.linalg.norm(moved - shown, axis=1).max() > APART
    assert np.abs(moved_pose - pose).max() > 0.1 or (np.abs(moved_controls - controls) > 0.01).all()
