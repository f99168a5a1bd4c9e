# SPDX-License-Identifier: GPL-3.0-or-later
"""The operators of the section Training Poses, without a window: previewed poses, bones, extra inputs and limits."""

import math

import bpy
import numpy as np
import pytest
from mathutils import Vector

from blend_fixtures.characters import control_rigs, controls
from fdda_addon.core.mathematics.poses import CONTROL, LOCATION, ROTATION, sample_pose
from fdda_addon.core.recording.index import read_index
from fdda_addon.core.recording.reader import Recording
from fdda_addon.panels import checks
from fdda_addon.panels.limits import sampled_channels_by_bone
from fdda_addon.panels.recording import cached_content
from fdda_addon.panels.sampling import describe_channels
from fdda_addon.poses.human_ranges import body_part_of, human_ranges
from fdda_addon.poses.motion_range import DEFAULT, rotation_ranges
from fdda_addon.poses.sampling import sampled_channels
from fdda_addon.properties import recording_options
from fdda_addon.properties.character import recording_folder
from fdda_addon.properties.recording_options import recording_settings
from fdda_addon.recording.plan import RecordingSettings, make_recording_overshoot, read_sampled_rig
from fdda_addon.rig.reading import read_rig
from fdda_addon.scene import undo
from fdda_addon.scene.active_rig import active_rig
from fdda_addon.scene.compatibility import animation_curves, is_selected, select_bone
from fdda_addon.scene.controls import control_default, suggested_controls
from fdda_addon.scene.scene_rig import SceneRig, find_rig

from ..arm_and_face import IK, recorded, saved
from ..conftest import ELBOW_RIG


def test_the_number_field_shows_the_poses_that_are_recorded(saved):
    session, bones, settings = (
        bpy.context.window_manager.fdda,
        saved.armature_object.pose.bones,
        saved.mesh_object.fdda.settings,
    )
    settings.seed, settings.spread = 7, 0.5
    channels = sampled_channels(saved, read_rig(saved))
    bpy.ops.fdda.rest_pose()
    assert session.preview_pose == 0
    for number in (5, 1):
        session.preview_pose = number
        assert session.preview_pose == number and session.pose_index == number - 1
        shown = [bones[c.name].rotation_euler[c.axis] for c in channels]
        np.testing.assert_allclose(shown, sample_pose(channels, 7, number - 1, 0.5), atol=1e-6)
    session.preview_pose = 0
    assert session.preview_pose == 0 and not any(any(bone.rotation_euler) for bone in bones)
    session.preview_pose = 3
    for bone in bones:
        bone.lock_rotation = (True, True, True)
    session.preview_pose = 5
    assert session.preview_pose == 3, "there is nothing to pose"


def set_limit(axis: str, low: float, high: float) -> None:
    """Press the button of an axis of the upper bone."""
    options = {"bone": "upper", "axes": [letter == axis for letter in "XYZ"], "low": [low] * 3, "high": [high] * 3}
    assert bpy.ops.fdda.set_limits("INVOKE_DEFAULT", **options) == {"FINISHED"}


def test_rest_pose_resets_the_bones_and_can_be_undone(saved):
    bpy.context.window_manager.fdda.preview_pose = 2
    bpy.ops.ed.undo_push()
    angle = saved.armature_object.pose.bones["lower"].rotation_euler[0]
    assert angle != 0
    assert bpy.ops.fdda.rest_pose() == {"FINISHED"}
    assert saved.armature_object.pose.bones["lower"].rotation_euler[0] == 0
    bpy.ops.ed.undo_push()
    bpy.ops.ed.undo()
    assert bpy.data.objects[ELBOW_RIG].pose.bones["lower"].rotation_euler[0] == pytest.approx(angle)


def test_poses_of_the_overshoot_are_shown_as_they_are_recorded(saved):
    settings = saved.mesh_object.fdda.settings
    settings.poses, settings.overshoot = 8, 2.0
    recording_settings = RecordingSettings(poses=8, overshoot=2.0)
    channels = sampled_channels(saved, read_rig(saved))
    overshoot = make_recording_overshoot(saved, recording_settings, channels)
    bones = saved.armature_object.pose.bones
    for number, expected_channels in ((5, channels), (6, overshoot.channels), (7, overshoot.channels)):
        bpy.context.window_manager.fdda.preview_pose = number + 1
        shown = [bones[c.name].rotation_euler[c.axis] for c in expected_channels]
        np.testing.assert_allclose(shown, sample_pose(expected_channels, 0, number), atol=1e-6)


def test_a_preview_ends_at_the_last_random_pose(saved):
    session = bpy.context.window_manager.fdda
    saved.mesh_object.fdda.settings.poses = 8
    session.preview_pose = 100
    assert session.preview_pose == 8


@pytest.mark.parametrize("operator", ["undo", "redo"])
def test_an_undo_cancels_the_step_that_is_to_be_added(saved, operator):
    bpy.context.window_manager.fdda.preview_pose = 2
    for name in ("first", "second"):
        bpy.ops.ed.undo_push(message=name)
    if operator == "redo":
        bpy.ops.ed.undo()
    for timer in undo.STEPS.values():
        bpy.app.timers.register(timer, first_interval=60)
    getattr(bpy.ops.ed, operator)()
    assert not any(map(bpy.app.timers.is_registered, undo.STEPS.values()))


def ranges(rig: SceneRig) -> dict[str, tuple[float, float]]:
    return {
        f"{c.name} {'XYZ'[c.axis]}": (round(math.degrees(c.low)), round(math.degrees(c.high)))
        for c in sampled_channels(rig, read_rig(rig))
    }


def test_a_range_is_written_to_the_existing_constraint(saved):
    bone = saved.armature_object.pose.bones["upper"]
    set_limit("Y", math.radians(10), math.radians(60))
    assert ranges(saved)["upper Y"] == (10, 60)
    assert math.degrees(bone.constraints[0].min_y) == pytest.approx(10)
    assert not bone.use_ik_limit_y


def test_a_bone_without_limits_gets_ik_limits_if_they_include_the_rest_pose(saved):
    bone = saved.armature_object.pose.bones["upper"]
    bone.constraints.remove(bone.constraints[0])
    bone.lock_rotation[2] = True
    set_limit("Z", -1, 0.5)
    assert ranges(saved)["upper Z"] == (-57, 29) and ranges(saved)["upper X"] == (-45, 45)
    assert bone.use_ik_limit_z and not bone.constraints
    with pytest.raises(RuntimeError, match="IK limits, which must include the rest pose; begin at 0 or below"):
        set_limit("X", 0.5, 1)
    bpy.ops.fdda.clear_limits(bone="upper", axes=(False, False, True))
    assert ranges(saved)["upper Z"] == (-45, 45)
    set_limit("X", 0.5, 1)
    assert ranges(saved)["upper X"] == (29, 57) and len(bone.constraints) == 1


def test_an_unknown_bone_is_refused(saved):
    with pytest.raises(RuntimeError, match="'elbow_rig' has no bone 'tail'; give the name of one"):
        bpy.ops.fdda.clear_limits(bone="tail")


DEFORMING = ("upper", "lower")

CONTROL_BONES = {"fk_upper", "fk_lower", "ik_hand", "ik_pole"}


def sampled_bones(recording: Recording) -> set[str]:
    return {channel.name for channel in recording.info.sampling.channels if channel.kind != CONTROL}


def select(rig: SceneRig, *names: str) -> None:
    for bone in rig.armature_object.pose.bones:
        owner = bone if hasattr(bone, "select") else bone.bone
        owner.select = bone.name in names


def wave(rig: SceneRig) -> bpy.types.Action:
    """Create a checked action that rotates the lower bone of the FK chain about X and blends to the IK chain."""
    bone, action = rig.armature_object.pose.bones["fk_lower"], bpy.data.actions.new("wave")
    rig.armature_object.animation_data_create().action = action
    for frame, angle, ik in ((1, 0.0, 0.0), (11, 0.8, 0.5)):
        bone.rotation_euler[0], rig.armature_object["ik"] = angle, ik
        bone.keyframe_insert("rotation_euler", index=0, frame=frame)
        rig.armature_object.keyframe_insert('["ik"]', frame=frame)
    assert len(animation_curves(action)) == 2
    action.fdda.record = True
    return action


class TestBones:
    def test_by_default_bones_with_weights_are_sampled(self, arm):
        assert recording_settings(arm).bones_to_pose == ()
        assert checks.check_now(arm).problems == ()
        assert sampled_channels_by_bone(arm) is None, "the list has the joints"

    def test_the_bones_of_a_collection_are_sampled(self, arm):
        settings = arm.mesh_object.fdda.settings
        settings.bones_to_pose = "COLLECTION"
        assert checks.check_now(arm).problems == (
            "Bones to Pose is set to Bone Collection, but no collection is chosen; choose one in Training Poses.",
        )
        with pytest.raises(RuntimeError, match="set to Bone Collection, but no collection is chosen"):
            bpy.ops.fdda.record()
        settings.bone_collection = control_rigs.CONTROLS
        bpy.ops.fdda.add_control(name=IK)
        check = checks.check_now(arm)
        assert check.problems == () and set(sampled_channels_by_bone(arm)) == CONTROL_BONES
        assert check.rig.joint_names == DEFORMING
        assert describe_channels(check) == "Random poses will move 4 bones (8 channels) and 1 extra input."
        recording = recorded(arm)
        assert recording.rig.joint_names == DEFORMING and sampled_bones(recording) == CONTROL_BONES
        assert [control.name for control in recording.rig.controls] == [IK]
        assert np.ptp(recording.controls, axis=0) > 0.1

    def test_a_missing_bone_collection_is_a_problem(self, arm):
        settings = arm.mesh_object.fdda.settings
        settings.bones_to_pose, settings.bone_collection = "COLLECTION", "Face"
        assert checks.check_now(arm).problems == (
            "'elbow_rig' has no bone collection 'Face'; its collections: 'Controls'.",
        )

    def test_the_keyed_channels_of_checked_actions_are_sampled(self, arm):
        settings = arm.mesh_object.fdda.settings
        settings.bones_to_pose = "ACTIONS"
        with pytest.raises(RuntimeError, match="but no action is checked; check one"):
            bpy.ops.fdda.record()
        action = wave(arm)
        check = checks.check_now(arm)
        assert check.problems == () and [control.name for control in check.automatic_controls] == [IK]
        (turn,) = sampled_channels_by_bone(arm)["fk_lower"]
        assert (turn.kind, turn.axis) == (ROTATION, 0)
        recording = recorded(arm)
        assert sampled_bones(recording) == {"fk_lower"}
        assert [source.name for source in recording.info.sampling.sources if source.name] == [action.name]
        (ik,) = (channel for channel in recording.info.sampling.channels if channel.kind == CONTROL)
        assert (ik.low, ik.high) == pytest.approx((0.0, 0.5))

    def test_the_ranges_follow_the_keys(self, arm):
        arm.mesh_object.fdda.settings.bones_to_pose = "ACTIONS"
        action = wave(arm)
        bone = arm.armature_object.pose.bones["fk_lower"]
        bone.constraints.remove(bone.constraints[0])
        bone.lock_rotation = (False, False, False)

        def turn() -> tuple[float, float]:
            (channel,) = sampled_by_bone_now(arm)["fk_lower"]
            return channel.low, channel.high

        assert turn() == pytest.approx((0.0, 0.8))
        assert turn() == pytest.approx((0.0, 0.8)), "measured once"
        curve = next(c for c in animation_curves(action) if c.data_path.endswith("rotation_euler"))
        curve.keyframe_points[1].co[1] = 0.4
        curve.update()
        assert turn() == pytest.approx((0.0, 0.4))
        for point in curve.keyframe_points:
            point.interpolation, point.back = "BACK", 3.0
        assert turn()[0] < -0.01 or turn()[1] > 0.41, "it overshoots between the keys"
        modifier = curve.modifiers.new("GENERATOR")
        modifier.coefficients = (0.0, 0.1)
        assert turn() == pytest.approx((0.1, 1.1)), "a modifier of the curve counts as well"

    def test_the_bones_that_were_selected_are_stored_and_sampled(self, arm):
        settings = arm.mesh_object.fdda.settings
        settings.bones_to_pose = "SELECTED"
        select(arm)
        assert checks.check_now(arm).problems[0].endswith("select bones and press Use Selected Bones.")
        with pytest.raises(RuntimeError, match="No bone of 'elbow_rig' is selected; select bones in Pose Mode"):
            bpy.ops.fdda.use_selected_bones()
        select(arm, "ik_hand", "ik_pole")
        assert bpy.ops.fdda.use_selected_bones() == {"FINISHED"}
        select(arm, "fk_upper")
        assert set(sampled_by_bone_now(arm)) == {"ik_hand", "ik_pole"}
        arm.armature_object["ik"] = 1.0
        recording = recorded(arm)
        assert sampled_bones(recording) == {"ik_hand", "ik_pole"}, "not those that are selected later"
        assert {channel.kind for channel in recording.info.sampling.channels} >= {LOCATION}
        bpy.ops.wm.save_mainfile()
        bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
        assert recording_settings(find_rig()).bones_to_pose == ("bone:ik_hand", "bone:ik_pole")

    def test_a_recording_with_other_sampled_bones_is_reported(self, arm):
        settings = arm.mesh_object.fdda.settings
        settings.bones_to_pose, settings.bone_collection = "COLLECTION", control_rigs.CONTROLS
        recorded(arm)
        checks.check_now(arm)
        assert cached_content(arm, recording_folder(arm.mesh_object)).sentence == ""
        select(arm, "fk_upper")
        bpy.ops.fdda.use_selected_bones()
        checks.check_now(arm)
        sentence = cached_content(arm, recording_folder(arm.mesh_object)).sentence
        assert sentence == "It was recorded with other settings than those above: range of motion."

    def test_choosing_other_control_bones_does_not_read_the_mesh_again(self, arm):
        settings = arm.mesh_object.fdda.settings
        settings.bones_to_pose, settings.bone_collection = "COLLECTION", control_rigs.CONTROLS
        first = checks.check_now(arm)
        select(arm, "fk_upper")
        bpy.ops.fdda.use_selected_bones()
        again = checks.check_now(arm)
        assert again.rig is first.rig and again.channels != first.channels


def sampled_by_bone_now(rig: SceneRig) -> dict:
    checks.check_now(rig)
    return sampled_channels_by_bone(rig)


class TestPreview:
    def test_previewed_poses_and_controls_are_those_that_are_recorded(self, arm):
        settings = arm.mesh_object.fdda.settings
        settings.bones_to_pose, settings.bone_collection = "COLLECTION", control_rigs.CONTROLS
        bpy.ops.fdda.add_control(name=IK)
        recording = recorded(arm)
        names = recording.rig.joint_names
        for number in (1, 4):
            bpy.context.window_manager.fdda.preview_pose = number + 1
            bpy.context.view_layer.update()
            shown = [np.array(arm.armature_object.pose.bones[name].matrix) for name in names]
            np.testing.assert_allclose(recording.pose_matrices[number], shown, atol=1e-5)
            assert arm.armature_object["ik"] == pytest.approx(recording.controls[number, 0], abs=1e-6)

    def test_the_rest_pose_resets_controls(self, face):
        keys = face.mesh_object.data.shape_keys.key_blocks
        keys["flexed"].value = keys["thin"].value = 0.5
        assert bpy.ops.fdda.rest_pose() == {"FINISHED"}
        assert keys["flexed"].value == keys["thin"].value == 0

    def test_the_rest_pose_works_without_sampled_bones(self, arm):
        arm.mesh_object.fdda.settings.bones_to_pose = "SELECTED"
        arm.armature_object.pose.bones["fk_upper"].rotation_euler[0] = 0.5
        assert bpy.ops.fdda.rest_pose() == {"FINISHED"}
        assert arm.armature_object.pose.bones["fk_upper"].rotation_euler[0] == 0

    def test_poses_are_previewed_even_if_only_actions_are_recorded(self, arm):
        settings = arm.mesh_object.fdda.settings
        settings.bones_to_pose, settings.bone_collection, settings.poses = "COLLECTION", control_rigs.CONTROLS, 0
        bpy.ops.fdda.rest_pose()
        bpy.context.window_manager.fdda.preview_pose = 1
        assert bpy.context.window_manager.fdda.preview_pose == 1


def test_shape_keys_are_recorded_in_the_given_or_default_range(face):
    assert bpy.ops.fdda.add_control(name="flexed") == {"FINISHED"}
    assert bpy.ops.fdda.add_control(name="thin") == {"FINISHED"}
    control = face.mesh_object.fdda.settings.extra_inputs["flexed"]
    control.has_range, control.low, control.high = True, 0.25, 0.75
    check = checks.check_now(face)
    assert check.problems == () and check.automatic_controls == ()
    assert describe_channels(check).endswith(" channels) and 2 extra inputs.")
    recording = recorded(face)
    ranges = {control.path: (control.low, control.high) for control in recording.rig.controls}
    assert ranges == {'key_blocks["flexed"].value': (0.25, 0.75), 'key_blocks["thin"].value': (-0.5, 1.0)}
    assert recording.controls[:, 0].min() >= 0.25 and recording.controls[:, 0].max() <= 0.75
    assert np.ptp(recording.controls[:, 0]) > 0.1


def test_shape_keys_are_inputs_without_being_added(face):
    keys = face.mesh_object.data.shape_keys
    for name in ("muted", "moves nothing"):
        face.mesh_object.shape_key_add(name=name, from_mix=False)
    keys.key_blocks["muted"].mute, keys.key_blocks["muted"].data[0].co.x = True, 1.0
    recorded(face)
    index = read_index(recording_folder(face.mesh_object))
    assert [control["path"] for control in index["controls"]] == [
        'key_blocks["flexed"].value',
        'key_blocks["thin"].value',
    ]


def test_an_unknown_control_is_a_problem_and_an_unnamed_one_is_not(face):
    with pytest.raises(RuntimeError, match="'elbow' has no control 'smile/'; give the name of a shape key"):
        bpy.ops.fdda.add_control(name="smile")
    settings = face.mesh_object.fdda.settings
    assert bpy.ops.fdda.add_control() == {"FINISHED"}
    assert checks.check_now(face).problems == (), "it is being filled in"
    settings.extra_inputs[0].name = "smile"
    assert checks.check_now(face).problems[0].startswith("'elbow' has no control 'smile/'")
    assert bpy.ops.fdda.remove_control() == {"FINISHED"}
    assert not settings.extra_inputs and checks.check_now(face).problems == ()
    with pytest.raises(RuntimeError, match="No extra input is active; click one in the list"):
        bpy.ops.fdda.remove_control()


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ('objects["elbow"].data.shape_keys.key_blocks["flexed"].value', "flexed"),
        ('shape_keys["KEYS"].key_blocks["thin"].value', "thin"),
        ('objects["elbow_rig"].pose.bones["upper"].location[1]', 'armature_object/pose.bones["upper"].location[1]'),
        ('armatures["elbow_rig"].display_type', None),
        ('objects["elbow"].data.shape_keys.key_blocks["gone"].value', None),
        ("objects", None),
    ],
)
def test_a_full_data_path_is_shortened(face, path, name):
    keys, armature = face.mesh_object.data.shape_keys, face.armature_object.data
    path = "bpy.data." + path.replace("KEYS", keys.name).replace(
        'armatures["elbow_rig"]', f'armatures["{armature.name}"]'
    )
    control = face.mesh_object.fdda.settings.extra_inputs.add()
    control.name = path
    assert control.name == (name or path)


def test_a_full_data_path_is_added_by_its_short_name(face):
    path = 'bpy.data.objects["elbow"].data.shape_keys.key_blocks["flexed"].value'
    assert bpy.ops.fdda.add_control(name=path) == {"FINISHED"}
    assert [control.name for control in face.mesh_object.fdda.settings.extra_inputs] == ["flexed"]
    with pytest.raises(RuntimeError, match="'flexed' is already in the list"):
        bpy.ops.fdda.add_control(name=path)


def test_an_empty_range_is_a_problem(face):
    bpy.ops.fdda.add_control(name="thin")
    control = face.mesh_object.fdda.settings.extra_inputs[0]
    control.has_range, control.low, control.high = True, 1.0, 0.5
    (problem,) = checks.check_now(face).problems
    assert problem.startswith("The control 'shape_keys/key_blocks[\"thin\"].value' has no range; give one")


def test_controls_that_drivers_read_are_detected(tmp_path):
    controls.custom_property()
    rig = saved(tmp_path)
    check = checks.check_now(rig)
    # The property acts through the key alone, so random poses set the key without its driver.
    assert [control.name for control in check.automatic_controls] == ['shape_keys/key_blocks["flexed"].value']
    _, channels = read_sampled_rig(rig, recording_settings(rig))
    assert channels == check.channels
    assert [channel.name for channel in channels if channel.kind == CONTROL] == [
        'shape_keys/key_blocks["flexed"].value'
    ]


def test_properties_are_suggested(arm):
    arm.armature_object.pose.bones["fk_upper"]["follow"] = 1.0
    names = suggested_controls(arm)
    assert names == [IK, 'armature_object/pose.bones["fk_upper"]["follow"]', "collection:Controls"]


def test_the_default_values_of_controls_are_read(arm):
    arm.armature_object.id_properties_ui("ik").update(default=0.25)
    arm.armature_object["on"] = True
    arm.armature_object.pose.bones["fk_upper"]["follow"] = 3
    bone = 'armature_object/pose.bones["fk_upper"]'
    assert control_default(arm, IK) == 0.25
    assert control_default(arm, 'armature_object/["on"]') == 0
    assert control_default(arm, f"{bone}.scale[1]") == 1 and control_default(arm, f"{bone}.location[1]") == 0
    assert control_default(arm, f'{bone}["follow"]') == 0


BONES = {
    "Hips": ((0, 0, 1.0), (0, 0, 1.1)),
    "LeftArm": ((0.2, 0, 1.4), (0.5, 0, 1.4)),
    "LeftForeArm": ((0.5, 0, 1.4), (0.8, 0, 1.4)),
    "RightArm": ((-0.2, 0, 1.4), (-0.5, 0, 1.4)),
    "RightForeArm": ((-0.5, 0, 1.4), (-0.8, 0, 1.4)),
    "tail": ((0, 0.2, 1.0), (0, 0.5, 1.0)),
}


@pytest.fixture
def armature_object() -> bpy.types.Object:
    """A small person in a T pose, with a mesh on the armature."""
    armature = bpy.data.armatures.new("person")
    armature_object = bpy.data.objects.new("person", armature)
    mesh_object = bpy.data.objects.new("body", bpy.data.meshes.new("body"))
    for o in (armature_object, mesh_object):
        bpy.context.scene.collection.objects.link(o)
    mesh_object.modifiers.new("Armature", "ARMATURE").object = armature_object
    bpy.context.view_layer.objects.active = armature_object
    bpy.ops.object.mode_set(mode="EDIT")
    for name, (head, tail) in BONES.items():
        bone = armature.edit_bones.new(f"mixamorig:{name}")
        bone.head, bone.tail = head, tail
        bone.align_roll(Vector((0, 0, 1)) if "Arm" in name else Vector((0, -1, 0)))
    bpy.ops.object.mode_set(mode="POSE")
    return armature_object


def bone(armature_object: bpy.types.Object, name: str) -> bpy.types.PoseBone:
    return armature_object.pose.bones[f"mixamorig:{name}"]


def select_bones(armature_object: bpy.types.Object, *names: str) -> None:
    for each in armature_object.pose.bones:
        select_bone(each, each.name.partition(":")[2] in names)
        assert is_selected(each) == (each.name.partition(":")[2] in names)


def degrees(pose_bone: bpy.types.PoseBone) -> list[tuple[float, float]]:
    return [(round(math.degrees(r.low)), round(math.degrees(r.high))) for r in rotation_ranges(pose_bone)]


def test_limits_of_all_selected_bones_are_set(armature_object):
    select_bones(armature_object, "LeftArm", "tail")
    low, high = (math.radians(-10), 0, math.radians(-30)), (math.radians(20), 1, math.radians(5))
    assert bpy.ops.fdda.set_limits(axes=(True, False, True), low=low, high=high) == {"FINISHED"}
    for name in ("LeftArm", "tail"):
        assert degrees(bone(armature_object, name)) == [(-10, 20), (-45, 45), (-30, 5)]
    assert all(r.source == DEFAULT for r in rotation_ranges(bone(armature_object, "Hips")))
    with pytest.raises(RuntimeError, match="The maximum about X must be larger than the minimum"):
        bpy.ops.fdda.set_limits(low=high, high=low)


def test_limits_are_copied_mirrored_and_cleared(armature_object):
    select_bones(armature_object, "LeftArm")
    low, high = ([math.radians(v) for v in values] for values in ((-10, -20, -30), (1, 2, 3)))
    bpy.ops.fdda.set_limits(low=low, high=high)
    assert bpy.ops.fdda.mirror_limits() == {"FINISHED"}
    assert degrees(bone(armature_object, "RightArm")) == [(-10, 1), (-2, 20), (-3, 30)]
    select_bones(armature_object, "tail", "Hips")
    assert bpy.ops.fdda.copy_limits(bone="mixamorig:LeftArm") == {"FINISHED"}
    assert degrees(bone(armature_object, "tail")) == degrees(bone(armature_object, "LeftArm"))
    assert bpy.ops.fdda.clear_limits() == {"FINISHED"}
    assert all(r.source == DEFAULT for r in rotation_ranges(bone(armature_object, "tail")))
    select_bones(armature_object, "tail")
    with pytest.raises(RuntimeError, match="No selected bone has a bone of the same name on the other side"):
        bpy.ops.fdda.mirror_limits()


def test_the_automatic_choice_of_bones_follows_the_limits(armature_object, monkeypatch):
    """As in a window, where an unchanged action is not read again."""
    monkeypatch.setattr(recording_options, "actions_state", lambda: None)
    rig = active_rig(bpy.context)
    pose_bone = bone(armature_object, "tail")
    for frame, angle in ((1, 0.0), (10, 0.5)):
        pose_bone.rotation_mode, pose_bone.rotation_euler = "XYZ", (angle, 0, 0)
        pose_bone.keyframe_insert("rotation_euler", frame=frame)
    for each in bpy.data.actions:
        each.fdda.record = False
    assert recording_options.bones_to_pose(rig) == "REMIX"
    select_bones(armature_object, "tail")
    bpy.ops.fdda.set_limits()
    assert recording_options.bones_to_pose(rig) == "WEIGHTS"
    bpy.ops.fdda.clear_limits()
    assert recording_options.bones_to_pose(rig) == "REMIX"


def test_operators_without_selected_bones_are_refused(armature_object):
    select_bones(armature_object)
    for operator in (bpy.ops.fdda.set_limits, bpy.ops.fdda.mirror_limits, bpy.ops.fdda.clear_limits):
        with pytest.raises(RuntimeError, match="No bone of 'person' is selected; check bones in the list"):
            operator()


def test_human_limits_are_set_for_body_parts_only(armature_object):
    assert bpy.ops.fdda.human_limits() == {"FINISHED"}
    assert all(r.source == DEFAULT for r in rotation_ranges(bone(armature_object, "tail")))
    # Forearms bend by a rotation about the Z axis of the body.
    for side, sign in (("Left", 1), ("Right", -1)):
        found = human_ranges(armature_object, bone(armature_object, f"{side}ForeArm").bone)
        axes = bone(armature_object, f"{side}ForeArm").bone.matrix_local.to_3x3().transposed()
        folding = max(range(3), key=lambda axis: abs(axes[axis].z))
        turned = axes[folding].z * sign * -1
        low, high = (round(math.degrees(v)) for v in found[folding])
        assert {low, high} == {0, 120 if turned > 0 else -120} or {low, high} == {0, -120 if turned < 0 else 120}
    with pytest.raises(RuntimeError, match="No bone of 'person' without limits has the name of a body part"):
        bpy.ops.fdda.human_limits()
    assert bpy.ops.fdda.human_limits(replace=True) == {"FINISHED"}


@pytest.mark.parametrize(
    ("name", "side"),
    [
        ("mixamorig:LeftForeArm", "left"),
        ("DEF-forearm.R", "right"),
        ("upper_arm.L", "left"),
        ("CC_Base_L_Thigh", "left"),
        ("Bip01 R Calf", "right"),
        ("hand_r", "right"),
        ("f_index.01.L", "left"),
        ("RightHandThumb2", "right"),
        ("spine.003", ""),
        ("Head", ""),
    ],
)
def test_bones_are_recognized_as_body_parts_by_name(name, side):
    ranges, found = body_part_of(name)
    assert ranges is not None and found == side


@pytest.mark.parametrize("name", ["tail", "skirt_01.L", "armor", "eye.L", "IK_target", "Bone.001"])
def test_other_bones_are_no_body_parts(name):
    assert body_part_of(name)[0] is None
