# SPDX-License-Identifier: GPL-3.0-or-later
"""The ranges in which actions move bones and controls."""

import math

import bpy
import pytest
from mathutils import Euler

from fdda_addon.poses.action_range import measured_controls, measured_ranges
from fdda_addon.scene.scene_rig import SceneRig

from ..figure import SMILE, WAVE, add_smile, add_wave, build_figure, key_channel


@pytest.fixture
def figure() -> SceneRig:
    rig = build_figure()
    add_wave(rig)
    return rig


def wave() -> bpy.types.Action:
    return bpy.data.actions[WAVE]


def test_keyed_channels_that_move_are_measured(figure):
    found = measured_ranges(figure.armature_object, [wave()])
    top = math.sin(11 / 23 * math.pi)  # Frames are whole numbers, and the maximum is between two frames.
    wanted = {
        ("spine", "rotation", 0): (0, 0.1 * top),
        ("spine", "rotation", 1): (0, 0.4 * top),
        ("spine", "location", 0): (0, 0.02 * top),
        ("spine", "location", 1): (0, 0.05 * top),
        ("arm.L", "rotation", 0): (0.2, 0.2 + top),
        ("arm.L", "rotation", 2): (0, 0.3 * top),
        ("arm.R", "rotation", 0): (0, 0.3 * top),
        ("arm.R", "rotation", 1): (0, 0.1 * top),
        ("arm.R", "scale", 1): (1, 1 + 0.1 * top),
    }
    assert found.keys() == wanted.keys()
    for place, bounds in wanted.items():
        assert found[place] == pytest.approx(bounds, abs=1e-6), place


def test_several_actions_are_measured_together(figure):
    spine = figure.armature_object.pose.bones["spine"]
    figure.armature_object.animation_data.action = bow = bpy.data.actions.new("bow")
    key_channel(spine, 1, "rotation_euler", (0, 0, 0))
    key_channel(spine, 9, "rotation_euler", (-1, 0, 0))
    found = measured_ranges(figure.armature_object, [wave(), bow])
    assert found["spine", "rotation", 0] == pytest.approx((-1, 0.1), abs=1e-3)
    assert found["spine", "rotation", 1] == pytest.approx((0, 0.4), abs=1e-2)


def test_quaternion_rotations_are_measured_beyond_180_degrees(figure):
    arm = figure.armature_object.pose.bones["arm.L"]
    figure.armature_object.animation_data.action = spin = bpy.data.actions.new("spin")
    for frame in range(37):
        turn = Euler((math.radians(10 * frame), 0, 0)).to_quaternion()
        # Two quaternions represent the same rotation, and an action may contain either of them.
        key_channel(arm, frame, "rotation_quaternion", -turn if frame % 2 else turn)
    found = measured_ranges(figure.armature_object, [spin])
    assert found == {("arm.L", "rotation", 0): pytest.approx((0, 2 * math.pi), abs=1e-5)}


def test_angles_that_jump_by_360_degrees_do_not_widen_a_range(figure):
    spine = figure.armature_object.pose.bones["spine"]
    figure.armature_object.animation_data.action = baked = bpy.data.actions.new("baked")
    for frame, degrees in enumerate((-10, 10, 370, 380, 15)):
        key_channel(spine, frame, "rotation_euler", (0, math.radians(degrees), 0))
    found = measured_ranges(figure.armature_object, [baked])
    assert found == {("spine", "rotation", 1): pytest.approx((-math.radians(10), math.radians(20)), abs=1e-5)}


def test_keys_of_an_unused_rotation_mode_are_ignored(figure):
    figure.armature_object.pose.bones["arm.L"].rotation_mode = "XYZ"
    assert not any(bone == "arm.L" for bone, _, _ in measured_ranges(figure.armature_object, [wave()]))


def test_keyed_properties_are_measured_as_controls(figure):
    add_smile(figure, wave())
    arm = figure.armature_object.pose.bones["arm.R"]
    constraint = arm.constraints.new("LIMIT_SCALE")
    for frame, influence in ((1, 0.25), (9, 0.75)):
        constraint.influence = influence
        constraint.keyframe_insert("influence", frame=frame)
    found = {c.name: (c.low, c.high) for c in measured_controls(figure, [wave()])}
    assert found.pop('armature_object/pose.bones["arm.L"]["fist"]') == pytest.approx((0, 1), abs=1e-2)
    assert found.pop('armature_object/pose.bones["arm.R"].constraints["Limit Scale"].influence') == (0.25, 0.75)
    assert found.pop(f"shape_keys/{SMILE}") == pytest.approx((0, 0.8), abs=1e-6)
    assert not found
