# SPDX-License-Identifier: GPL-3.0-or-later
"""Random poses from actions: only what the actions key, in the ranges that they use."""

import math

import bpy
import numpy as np
import pytest
from mathutils import Euler, Quaternion

from fdda_addon.core.errors import RigError
from fdda_addon.core.mathematics.poses import CONTROL, ROTATION_VECTOR, Channel, sample_pose
from fdda_addon.panels.limits import _format_channels
from fdda_addon.poses.action_range import measured_ranges
from fdda_addon.poses.sample_selection import select_bones
from fdda_addon.poses.sampling import sampled_channels, selected_channels
from fdda_addon.recording.plan import RecordingSettings, read_sampled_rig
from fdda_addon.rig.reading import read_rig
from fdda_addon.scene.armature import Poser
from fdda_addon.scene.compatibility import animation_curves, select_bone
from fdda_addon.scene.scene_rig import SceneRig

from ..figure import WAVE, add_wave, build_figure, key_channel

ARM = "arm.L"


@pytest.fixture
def figure() -> SceneRig:
    return build_figure()


def sampled(rig: SceneRig, *texts: str) -> tuple[Channel, ...]:
    texts = texts or tuple(f"action:{action.name}" for action in bpy.data.actions)
    return selected_channels(rig.armature_object, select_bones(rig, texts))


def ranges(channels: tuple[Channel, ...], bone: str) -> dict:
    return {(c.kind, c.axis): (c.low, c.high) for c in channels if c.name == bone}


def limit(bone: bpy.types.PoseBone, kind: str, **values: float) -> bpy.types.Constraint:
    constraint = bone.constraints.new(kind)
    constraint.owner_space = "LOCAL"
    for name, value in values.items():
        use = name if hasattr(constraint, f"use_{name}") else f"limit_{name[-1]}"
        setattr(constraint, f"use_{use}", True)
        setattr(constraint, name, value)
    return constraint


def test_limits_narrow_the_keyed_ranges_and_add_no_channels(figure):
    add_wave(figure)
    spine = figure.armature_object.pose.bones["spine"]
    limit(spine, "LIMIT_SCALE", min_x=0.0, max_x=2.0)
    limit(spine, "LIMIT_LOCATION", min_x=-1.0, max_x=0.01, min_z=-1.0, max_z=1.0)
    limit(spine, "LIMIT_ROTATION", min_x=-1.5, max_x=1.5, min_y=0.0, max_y=0.25, min_z=-1.5, max_z=1.5)
    channels = sampled(figure)
    found = ranges(channels, "spine")
    assert found == {
        ("rotation", 0): pytest.approx((0, 0.1), abs=1e-3),
        ("rotation", 1): pytest.approx((0, 0.25)),
        ("location", 0): pytest.approx((0, 0.01)),
        ("location", 1): pytest.approx((0, 0.05), abs=1e-3),
    }
    # A bone that is also chosen by name moves in its whole range.
    both = ranges(sampled(figure, "bone:spine", f"action:{WAVE}"), "spine")
    assert both["scale", 0] == (0, 2) and both["rotation", 0] == (-1.5, 1.5)


def test_muted_curves_of_an_action_are_not_sampled(figure):
    action = add_wave(figure)
    curves = {(c.data_path, c.array_index): c for c in animation_curves(action)}
    curves['pose.bones["spine"].rotation_euler', 1].mute = True
    curves['pose.bones["arm.L"]["fist"]', 0].mute = True
    assert ("rotation", 1) not in ranges(sampled(figure), "spine")
    assert select_bones(figure, [f"action:{WAVE}"]).controls == ()


def test_a_channel_keyed_at_a_constant_value_keeps_the_value(figure):
    spine = figure.armature_object.pose.bones["spine"]
    figure.armature_object.animation_data_create().action = bpy.data.actions.new("lean")
    for frame, turn in ((1, -0.2), (9, 0.2)):
        key_channel(spine, frame, "rotation_euler", (0.75, turn, 0))
        key_channel(spine, frame, "location", (0, 0.5, 0))
    channels = sampled(figure)
    assert _format_channels(list(channels), True) == "locked  ±11°  locked"
    assert ranges(channels, "spine") == {
        ("rotation", 0): (0.75, 0.75),
        ("rotation", 1): pytest.approx((-0.2, 0.2)),
        ("location", 1): (0.5, 0.5),
    }


def test_a_control_keyed_at_a_constant_value_keeps_the_value(figure):
    """For example, a switch from IK to FK has the value of the action in all poses, whatever its value in the file."""
    arm = figure.armature_object.pose.bones[ARM]
    add_wave(figure)
    for frame in (1, 9):
        for name, value in (("switch", 1.0), ("same", 0.5)):
            arm[name] = value
            arm.keyframe_insert(f'["{name}"]', frame=frame)
    figure.armature_object.animation_data.action = None
    arm["switch"] = 0.0
    channels = sampled_channels(figure, read_rig(figure), select_bones(figure, [f"action:{WAVE}"]))
    found = {c.name.partition("/")[2]: (c.low, c.high) for c in channels if c.kind == CONTROL}
    assert found.keys() == {f'pose.bones["{ARM}"]["switch"]', f'pose.bones["{ARM}"]["fist"]'}
    assert found[f'pose.bones["{ARM}"]["switch"]'] == (1, 1)


def about(*degrees: float) -> Quaternion:
    return Euler([math.radians(angle) for angle in degrees]).to_quaternion()


CONE = [Quaternion([math.radians(10) * part for part in (math.cos(n), 0, math.sin(n))]) for n in range(24)]
"""Rotations by 10 degrees about all directions across Y."""
MOTIONS = {
    "half a turn away": ([about(a, 5, 0) for a in (165, 175, 185)], [about(a, -5, 0) for a in (-165, 175)]),
    "beyond half a turn": ([about(a, 0, 0) for a in range(0, 280, 10)], [about(a, 0, 0) for a in range(270, 190, -10)]),
    "gimbal lock": ([about(0, 90, 0) @ turn for turn in CONE],),
    "away from the rest pose": ([about(80, a, 0) for a in (-20, 0, 20)],),
}


@pytest.mark.parametrize("mode", ["QUATERNION", "AXIS_ANGLE"])
@pytest.mark.parametrize("motion", MOTIONS)
def test_random_poses_are_close_to_the_poses_of_actions(figure, motion, mode):
    bone = figure.armature_object.pose.bones[ARM]
    bone.rotation_mode = mode
    for turns in MOTIONS[motion]:
        figure.armature_object.animation_data_create().action = bpy.data.actions.new("turns")
        for frame, turn in enumerate(turns):
            axis, angle = turn.to_axis_angle()
            value = {"rotation_quaternion": turn} if mode == "QUATERNION" else {"rotation_axis_angle": (angle, *axis)}
            key_channel(bone, frame, *value.popitem())
    channels = sampled(figure)
    assert {channel.kind for channel in channels} == {ROTATION_VECTOR}
    poser = Poser(figure, channels)
    keyed = np.array([turn for turns in MOTIONS[motion] for turn in turns])
    drawn = []
    for number in range(100):
        poser.set(sample_pose(channels, 0, number, spread=10))
        axis_angle = bone.rotation_axis_angle
        drawn.append(bone.rotation_quaternion if mode == "QUATERNION" else Quaternion(axis_angle[1:], axis_angle[0]))
        drawn[-1] = drawn[-1].copy()
    apart = 2 * np.arccos(np.clip(np.abs(np.array(drawn) @ keyed.T).max(axis=1), 0, 1))
    assert np.degrees(apart.max()) < 20


def test_euler_angles_of_several_actions_do_not_wrap(figure):
    bone = figure.armature_object.pose.bones[ARM]
    for turns in MOTIONS["half a turn away"]:
        figure.armature_object.animation_data_create().action = bpy.data.actions.new("turns")
        for frame, turn in enumerate(turns):
            key_channel(bone, frame, "rotation_quaternion", turn)
    found = measured_ranges(figure.armature_object, bpy.data.actions)
    assert found[ARM, "rotation", 0] == pytest.approx((math.radians(165), math.radians(195)), abs=1e-4)
    assert found[ARM, "rotation", 1] == pytest.approx((math.radians(-5), math.radians(5)), abs=1e-4)
    # A bone with a limit is sampled about its axes, so that the limit narrows the range.
    limit(bone, "LIMIT_ROTATION", min_x=0.0, max_x=math.radians(180))
    assert ranges(sampled(figure), ARM)["rotation", 0] == pytest.approx((math.radians(165), math.pi), abs=1e-4)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"extra_inputs": ("collection:Empty", "bone:spine")},
            "The bone collection 'Empty' of 'figure_rig' has no bones;",
        ),
        (
            {"bones_to_pose": ("collection:Empty", "bone:spine")},
            "The bone collection 'Empty' of 'figure_rig' has no bones;",
        ),
        (
            {"bones_to_pose": ("selected", "bone:spine")},
            "No bone of 'figure_rig' is selected; select bones in Pose Mode",
        ),
        (
            {"bones_to_pose": ("action:nothing", "bone:spine")},
            "The action 'nothing' chooses nothing to sample: it keys no bone",
        ),
    ],
)
def test_selections_without_bones_are_refused(figure, settings, message):
    figure.armature_object.data.collections.new("Empty")
    bpy.data.actions.new("nothing")
    for bone in figure.armature_object.pose.bones:
        select_bone(bone, False)
    with pytest.raises(RigError, match=message):
        read_sampled_rig(figure, RecordingSettings(**settings))
