# SPDX-License-Identifier: GPL-3.0-or-later
"""The sources of the range of motion, and how bones of every rotation mode are posed in it."""

import math

import bpy
import numpy as np
import pytest
from mathutils import Euler, Matrix

from fdda_addon.core.errors import RigError
from fdda_addon.core.mathematics.poses import DEFAULT_RANGE, Channel, sample_pose
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.poses.sampling import sampled_channels
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.recording.run import record
from fdda_addon.rig.reading import read_rig
from fdda_addon.scene.armature import Poser, clear_pose
from fdda_addon.scene.scene_rig import SceneRig

from ..scene_state import drain, fresh_elbow


@pytest.fixture
def fresh() -> SceneRig:
    """An elbow without limits. Each test sets its own limits."""
    rig = fresh_elbow()
    rig.armature_object.animation_data_clear()
    clear_pose(rig.armature_object)
    for bone in rig.armature_object.pose.bones:
        bone.lock_location = bone.lock_scale = (False, False, False)
        while bone.constraints:
            bone.constraints.remove(bone.constraints[0])
    return rig


@pytest.fixture
def lower(fresh) -> bpy.types.PoseBone:
    return fresh.armature_object.pose.bones["lower"]


def ranges(rig: SceneRig, bone: str = "lower", kind: str = "rotation") -> dict[int, tuple[float, float]]:
    """Range by axis of the channels of a bone, in degrees or meters."""
    scale = 180 / math.pi if kind == "rotation" else 1
    return {
        c.axis: (round(c.low * scale, 3), round(c.high * scale, 3))
        for c in sampled_channels(rig, read_rig(rig))
        if (c.name, c.kind) == (bone, kind)
    }


def limit(bone, kind="LIMIT_ROTATION", space="LOCAL", **axes):
    constraint = bone.constraints.new(kind)
    constraint.owner_space = space
    for axis, (low, high) in axes.items():
        if kind == "LIMIT_ROTATION":
            setattr(constraint, f"use_limit_{axis}", True)
        else:
            setattr(constraint, f"use_min_{axis}", True)
            setattr(constraint, f"use_max_{axis}", True)
        setattr(constraint, f"min_{axis}", low)
        setattr(constraint, f"max_{axis}", high)
    return constraint


def test_default(fresh):
    degrees = tuple(math.degrees(angle) for angle in DEFAULT_RANGE)
    assert degrees == (-45, 45)
    assert ranges(fresh) == ranges(fresh, "upper") == dict.fromkeys(range(3), degrees)


def test_limit_rotation(fresh, lower):
    limit(lower, x=(0.0, 2.0), z=(0.0, 0.0))
    assert ranges(fresh) == {0: (0, 114.592), 1: (-45, 45)}


def test_limit_rotation_in_another_space_or_muted_says_nothing(fresh, lower):
    limit(lower, space="WORLD", x=(0, 2))
    limit(lower, x=(0, 2)).mute = True
    assert ranges(fresh)[0] == (-45, 45)


def test_ik_limits(fresh, lower):
    lower.use_ik_limit_x, lower.ik_min_x, lower.ik_max_x = True, -0.5, 1.0
    lower.lock_ik_y = True
    assert ranges(fresh) == {0: (-28.648, 57.296), 2: (-45, 45)}


def test_limit_rotation_goes_before_ik_limits(fresh, lower):
    lower.use_ik_limit_x, lower.ik_min_x, lower.ik_max_x = True, -0.5, 1.0
    limit(lower, x=(0.0, 2.0))
    assert ranges(fresh)[0] == (0, 114.592)


def test_lock_flags(fresh, lower):
    lower.lock_rotation = (True, False, True)
    limit(lower, x=(0, 2), y=(0, 1))
    assert ranges(fresh) == {1: (0, 57.296)}


def test_limit_location(fresh):
    upper = fresh.armature_object.pose.bones["upper"]
    constraint = limit(upper, "LIMIT_LOCATION", x=(-0.1, 0.2), y=(0, 0.1), z=(0, 0))
    upper.lock_location[1] = True
    assert ranges(fresh, "upper", "location") == {0: (-0.1, 0.2)}
    constraint.use_max_x = False
    assert ranges(fresh, "upper", "location") == {}, "without an end it is no range"


def test_a_connected_bone_has_no_location(fresh, lower):
    limit(lower, "LIMIT_LOCATION", x=(-0.1, 0.2))
    assert lower.bone.use_connect
    assert ranges(fresh, "lower", "location") == {}


def test_a_bone_that_a_constraint_moves_is_left_out(fresh, lower):
    constraint = lower.constraints.new("COPY_ROTATION")
    assert ranges(fresh) == {}
    constraint.mute = True
    assert len(ranges(fresh)) == 3


def add_bone(rig: SceneRig, name: str, parent: str | None = None, deform: bool = False) -> bpy.types.PoseBone:
    bpy.context.view_layer.objects.active = rig.armature_object
    bpy.ops.object.mode_set(mode="EDIT")
    bones = rig.armature_object.data.edit_bones
    bone = bones.new(name)
    bone.head, bone.tail, bone.use_deform = (0, 0, 0.5), (0, 0, 0.7), deform
    bone.parent = bones[parent] if parent else None
    bpy.ops.object.mode_set(mode="OBJECT")
    return rig.armature_object.pose.bones[name]


def test_a_control_bone_with_a_range_is_sampled_and_no_joint(fresh):
    control = add_bone(fresh, "control")
    assert ranges(fresh, "control") == {}
    limit(control, x=(0, 1))
    assert ranges(fresh, "control")[0] == (0, 57.296)
    assert read_rig(fresh).joint_names == ("upper", "lower")


def test_ancestors_of_joints_are_joints(fresh):
    root = add_bone(fresh, "root")
    bpy.ops.object.mode_set(mode="EDIT")
    bones = fresh.armature_object.data.edit_bones
    bones["upper"].parent = bones["root"]
    bpy.ops.object.mode_set(mode="OBJECT")
    rig = read_rig(fresh)
    assert rig.joint_names == ("root", "upper", "lower") and rig.parents.tolist() == [-1, 0, 1]
    assert root.name == "root"


def test_nothing_to_sample(fresh):
    for bone in fresh.armature_object.pose.bones:
        bone.lock_rotation = (True, True, True)
    with pytest.raises(RigError, match=r"No bone of 'elbow_rig' may be sampled: all 2 are locked .* --poses 0"):
        sampled_channels(fresh, read_rig(fresh))


@pytest.mark.parametrize("mode", ["XYZ", "QUATERNION", "AXIS_ANGLE"])
def test_posing_in_every_rotation_mode(fresh, lower, mode):
    lower.rotation_mode = mode
    angles = (0.3, -0.5, 0.8)
    Poser(fresh, tuple(Channel("lower", "rotation", axis, -1, 1) for axis in range(3))).set(np.array(angles))
    bpy.context.view_layer.update()
    found = np.array(lower.matrix_basis)
    np.testing.assert_allclose(found, np.array(Euler(angles).to_matrix().to_4x4()), atol=1e-6)


def test_posing_locations(fresh):
    upper = fresh.armature_object.pose.bones["upper"]
    channels = (Channel("upper", "location", 2, -1, 1), Channel("upper", "rotation", 0, -1, 1))
    Poser(fresh, channels).set(np.array([0.25, 0.5]))
    bpy.context.view_layer.update()
    expected = Matrix.Translation((0, 0, 0.25)) @ Euler((0.5, 0, 0)).to_matrix().to_4x4()
    np.testing.assert_allclose(np.array(upper.matrix_basis), np.array(expected), atol=1e-6)


def test_a_recording_poses_quaternion_bones_and_locations(fresh, lower, tmp_path):
    upper = fresh.armature_object.pose.bones["upper"]
    upper.rotation_mode, lower.rotation_mode = "QUATERNION", "AXIS_ANGLE"
    limit(upper, "LIMIT_LOCATION", z=(-0.1, 0.1))
    drain(record(fresh, tmp_path / "r", RecordingSettings(poses=5)))
    recording = read_recording(tmp_path / "r")
    channels = recording.info.sampling.channels
    assert [(c.name, c.kind, c.axis) for c in channels] == [
        *(("upper", "rotation", axis) for axis in range(3)),
        ("upper", "location", 2),
        *(("lower", "rotation", axis) for axis in range(3)),
    ]
    for index, pose in enumerate(recording.pose_matrices[:5]):
        values = sample_pose(channels, 0, index)
        basis = Matrix.Translation((0, 0, values[3])) @ Euler(values[:3]).to_matrix().to_4x4()
        expected = fresh.armature_object.data.bones["upper"].matrix_local @ basis
        np.testing.assert_allclose(pose[0], np.array(expected), atol=1e-5)
