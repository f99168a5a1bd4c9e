# SPDX-License-Identifier: GPL-3.0-or-later
"""The bones that random poses move, chosen in the sidebar, and the previewed poses."""

import bpy
import numpy as np
import pytest

from blend_fixtures.characters import control_rigs
from fdda_addon.core.mathematics.poses import CONTROL, LOCATION, ROTATION
from fdda_addon.core.recording.reader import Recording
from fdda_addon.panels import checks
from fdda_addon.panels.limits import sampled_channels_by_bone
from fdda_addon.panels.recording import cached_content
from fdda_addon.panels.sampling import describe_channels
from fdda_addon.properties.character import recording_folder
from fdda_addon.properties.recording_options import recording_settings
from fdda_addon.scene.compatibility import animation_curves
from fdda_addon.scene.scene_rig import SceneRig, find_rig

from ..arm_and_face import IK, recorded

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
