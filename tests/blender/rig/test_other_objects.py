# SPDX-License-Identifier: GPL-3.0-or-later
"""Bones of a second armature that deform the mesh are inputs or refused by name; free objects are named in a note."""

from collections.abc import Callable

import bpy
import numpy as np
import pytest
from mathutils import Euler

from blend_fixtures.characters import stacks
from blend_fixtures.characters.base import drive, link, tube
from blend_fixtures.characters.bones import NewBone, add_bones, limit
from blend_fixtures.characters.controls import add_cast
from blend_fixtures.characters.skinning import two_armatures
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
ARMATURE, BONE = "muscle_rig", "muscle"
FOLLOWS = (
    "'elbow' follows the bone '{}' of a second armature, 'muscle_rig', which can {}, but is no input of the model; {}, "
    "or join the armatures."
)
EULER, LOCKED = "set its rotation mode to XYZ Euler", "lock its {} (or add {} in local space)"
ALL = FOLLOWS.format(
    BONE,
    "rotate and move and scale",
    f"{EULER} and {LOCKED.format('location and scale', 'Limit Location and Limit Scale')}",
)
READS = 'pose.bones["muscle"].rotation_quaternion[1]'


def muscle_bone() -> bpy.types.PoseBone:
    return bpy.data.objects[ARMATURE].pose.bones[BONE]


def with_settings(**settings: object) -> Callable[[], None]:
    """Return a function that builds a character with two armatures and changes the bone of the second one."""

    def build() -> None:
        two_armatures()
        for name, value in settings.items():
            setattr(muscle_bone(), name, value)

    return build


def free_root() -> None:
    """The parent of the deforming bone is a non-deforming bone without limits."""
    two_armatures()
    armature_object = bpy.data.objects[ARMATURE]
    add_bones(armature_object, NewBone("root", (0.1, 0.0, -0.1), (0.1, 0.0, 0.0), is_deforming=False))
    bpy.context.view_layer.objects.active = armature_object
    bpy.ops.object.mode_set(mode="EDIT")
    armature_object.data.edit_bones[BONE].parent = armature_object.data.edit_bones["root"]
    bpy.ops.object.mode_set(mode="OBJECT")
    armature_object.pose.bones["root"].lock_rotation = (False, False, False)
    armature_object.pose.bones["root"].rotation_mode = "QUATERNION"


def unlock(pose_bone: bpy.types.PoseBone) -> None:
    pose_bone.rotation_mode = "QUATERNION"
    pose_bone.lock_location = pose_bone.lock_rotation = pose_bone.lock_scale = (False, False, False)


def add_unlocked_armature() -> bpy.types.Object:
    """Add a second armature with Blender's defaults: quaternion rotation and no locks."""
    armature_object = link(bpy.data.objects.new(ARMATURE, bpy.data.armatures.new(ARMATURE)))
    add_bones(armature_object, NewBone(BONE, (0.1, 0.0, 0.0), (0.1, 0.0, 0.1)))
    unlock(armature_object.pose.bones[BONE])
    return armature_object


def hook_on_a_bone() -> None:
    handle = free_hook()
    matrix = handle.matrix_world.copy()
    handle.parent, handle.parent_type, handle.parent_bone = add_unlocked_armature(), "BONE", BONE
    bpy.context.view_layer.update()
    handle.matrix_world = matrix


def hook_that_copies_the_rig() -> None:
    copy = free_hook().constraints.new("COPY_TRANSFORMS")
    copy.target, copy.subtarget = bpy.data.objects["elbow_rig"], "lower"


def hook_that_copies_a_bone() -> None:
    copy = free_hook().constraints.new("COPY_TRANSFORMS")
    copy.target, copy.subtarget = add_unlocked_armature(), BONE


def lattice_on_a_bone() -> None:
    stacks.lattice()
    lattice_object = bpy.data.objects["lattice"]
    lattice_object.vertex_groups.new(name=BONE).add(range(54), 1.0, "REPLACE")
    lattice_object.modifiers.new("Muscles", "ARMATURE").object = add_unlocked_armature()


def driver_of_a_transform() -> None:
    drive(add_cast(tube()[0]), "factor", add_unlocked_armature(), (BONE, "ROT_X"))


def driver_of_a_channel() -> None:
    """A driver of a modifier reads a component of a bone's quaternion, although a constraint replaces the rotation."""
    mesh_object, rig = tube()
    constraint = add_unlocked_armature().pose.bones[BONE].constraints.new("COPY_ROTATION")
    constraint.target, constraint.subtarget = rig, "lower"
    drive(add_cast(mesh_object), "factor", bpy.data.objects[ARMATURE], READS)


REFUSED = {
    "quaternion": (with_settings(rotation_mode="QUATERNION"), FOLLOWS.format(BONE, "rotate", EULER)),
    "axis and angle": (with_settings(rotation_mode="AXIS_ANGLE"), FOLLOWS.format(BONE, "rotate", EULER)),
    "location": (
        with_settings(lock_location=(True, True, False)),
        FOLLOWS.format(BONE, "move", LOCKED.format("location", "Limit Location")),
    ),
    "scale": (
        with_settings(lock_scale=(False, False, False)),
        FOLLOWS.format(BONE, "scale", LOCKED.format("scale", "Limit Scale")),
    ),
    "root": (free_root, FOLLOWS.format("root", "rotate", EULER)),
    "parent of a hook": (hook_on_a_bone, ALL),
    "constraint of a hook": (hook_that_copies_a_bone, ALL),
    "lattice": (lattice_on_a_bone, ALL),
    "driver of a transform": (driver_of_a_transform, ALL),
    "driver of a channel": (
        driver_of_a_channel,
        f"A driver of 'elbow' reads '{READS}' of a second armature, 'muscle_rig', which is no input of the model; name "
        f"it as a control with a range (--extra-input 'object:muscle_rig/{READS}=LOW:HIGH'), or lock it.",
    ),
}


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


@pytest.mark.parametrize("name", REFUSED)
def test_a_bone_that_is_no_input_of_the_model_is_named(name, loose_model, tmp_path):
    build, sentence = REFUSED[name]
    rig = build_rig(build)
    before = scene_state(rig)
    assert sentence in check_recordable_rig(rig).problems
    with pytest.raises(RigError) as error:
        drain(record(rig, tmp_path / "recording", FEW_POSES))
    assert str(error.value) == sentence
    # This model is not told of Euler angles either.
    with pytest.raises(RigError, match=r" of a second armature, 'muscle_rig', .*is no input of the model; "):
        drain(evaluate(rig, loose_model, EvaluationSettings(poses=2)))
    with pytest.raises(RigError, match=r" of a second armature, 'muscle_rig', .*is no input of the model; "):
        bind(rig, loose_model)
    assert_same_state(before, scene_state(rig))
    still = evaluated_positions(rig.mesh_object)
    move(bpy.data.objects[ARMATURE].pose.bones["root" if name == "root" else BONE])
    assert np.linalg.norm(evaluated_positions(rig.mesh_object) - still, axis=1).max() > APART, "it is a case"


def limited_location() -> None:
    two_armatures()
    limit(muscle_bone(), "LIMIT_LOCATION", {2: (-0.02, 0.02)})


def copied_from_the_first() -> None:
    """The unlocked bone copies the transforms of a non-deforming bone of the first armature."""
    two_armatures()
    armature_object = bpy.data.objects["elbow_rig"]
    add_bones(armature_object, NewBone("handle", (0.1, 0.0, 0.0), (0.1, 0.0, 0.1), is_deforming=False))
    limit(armature_object.pose.bones["handle"], "LIMIT_ROTATION", {0: (-20.0, 20.0)})
    unlock(muscle_bone())
    copy = muscle_bone().constraints.new("COPY_TRANSFORMS")
    copy.target, copy.subtarget = armature_object, "handle"


EXPECTED = {
    two_armatures: {"rotation_euler[0]", "rotation_euler[2]"},
    limited_location: {"rotation_euler[0]", "rotation_euler[2]", "location[2]"},
    copied_from_the_first: set(),
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
    bone = rig.armature_object.pose.bones["handle"] if build is copied_from_the_first else muscle_bone()
    for axis in (0, 2):
        bone.rotation_euler[axis] = 0.3
        bone.location[axis] = 0.0 if bone.lock_location[axis] else 0.02
    bpy.context.view_layer.update()
    moved_pose, moved, moved_controls = evaluator.evaluate()
    assert np.linalg.norm(moved - shown, axis=1).max() > APART
    assert np.abs(moved_pose - pose).max() > 0.1 or (np.abs(moved_controls - controls) > 0.01).all()


def free_hook() -> bpy.types.Object:
    stacks.hook()
    handle = bpy.data.objects["handle"]
    matrix = handle.matrix_world.copy()
    handle.parent, handle.matrix_world = None, matrix
    return handle


def hook_of_another_armature() -> None:
    free_hook().parent = add_unlocked_armature()


def hook_on_another_armature() -> None:
    stacks.hook()
    bpy.data.objects["elbow"].modifiers["Hook"].object = add_unlocked_armature()


INDEPENDENT = {
    free_hook: ("the object 'handle'", "handle"),
    hook_of_another_armature: ("the 2 objects 'handle' and 'muscle_rig'", ARMATURE),
    hook_on_another_armature: ("the object 'muscle_rig'", ARMATURE),
    stacks.hook: ("", ""),
    hook_that_copies_the_rig: ("", ""),
}


@pytest.mark.parametrize("build", INDEPENDENT, ids=lambda build: build.__name__)
def test_objects_that_do_not_move_with_the_armature_are_named(build, loose_model, tmp_path):
    rig, (objects, moved_name) = build_rig(build), INDEPENDENT[build]
    bpy.context.view_layer.update()
    sentence = objects and (
        f"The surface of 'elbow' depends on the place of {objects}, which no parent or constraint attaches to "
        "'elbow_rig': the model keeps the place in the recording. If one has to move with the character, parent it to "
        "the armature or a bone; if something else moves it, make that an extra input (--extra-input)."
    )
    settings = RecordingSettings(poses=4, influence_poses=1)
    steps = list(record(rig, tmp_path / "recording", settings))
    assert [step.note for step in steps if "disk" not in step.note and step.note] == [sentence] * bool(sentence)
    if sentence:
        still = evaluated_positions(rig.mesh_object)
        bpy.data.objects[moved_name].location.z += 0.1
        bpy.context.view_layer.update()
        assert np.abs(evaluated_positions(rig.mesh_object) - still).max() > APART, "it is a case"
    assert bind(rig, loose_model) == sentence


def test_an_object_that_controls_move_is_not_named(tmp_path):
    rig = build_rig(free_hook)
    controls = tuple(f"object:handle/location[{axis}]=-0.1:0.1" for axis in range(3))
    settings = RecordingSettings(poses=4, influence_poses=1, extra_inputs=controls)
    steps = list(record(rig, tmp_path / "recording", settings))
    assert not [step.note for step in steps if "disk" not in step.note and step.note]
