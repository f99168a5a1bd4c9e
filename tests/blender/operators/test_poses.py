# SPDX-License-Identifier: GPL-3.0-or-later
"""The operators of the section Training Poses, without a window: previewed poses, and the limits of one bone."""

import math

import bpy
import numpy as np
import pytest

from fdda_addon.core.mathematics.poses import sample_pose
from fdda_addon.poses.sampling import sampled_channels
from fdda_addon.recording.plan import RecordingSettings, make_recording_overshoot
from fdda_addon.rig.reading import read_rig
from fdda_addon.scene import undo
from fdda_addon.scene.scene_rig import SceneRig

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


def test_the_previewed_pose_follows_changed_limits_and_a_pose_by_hand_does_not(saved):
    bone = saved.armature_object.pose.bones["upper"]
    bpy.context.window_manager.fdda.preview_pose = 2
    set_limit("Y", math.radians(70), math.radians(80))
    assert math.radians(70) <= bone.rotation_euler[1] <= math.radians(80)
    bone.rotation_euler = (0.1, 0.2, 0.3)
    set_limit("Y", math.radians(10), math.radians(20))
    np.testing.assert_allclose(bone.rotation_euler, (0.1, 0.2, 0.3), atol=1e-6)


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
