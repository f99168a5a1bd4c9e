# SPDX-License-Identifier: GPL-3.0-or-later
"""Ranges of motion, from limits and from actions, and how bones are posed in them."""

import math

import bpy
import numpy as np
import pytest
from mathutils import Euler, Matrix, Quaternion

from blend_fixtures.characters.bones import NewBone, add_bones
from fdda_addon.core.errors import RigError
from fdda_addon.core.mathematics.poses import CONTROL, DEFAULT_RANGE, ROTATION_VECTOR, Channel, sample_pose
from fdda_addon.panels.limits import _format_channels
from fdda_addon.poses.action_range import measured_controls, measured_ranges
from fdda_addon.poses.sample_selection import select_bones
from fdda_addon.poses.sampling import sampled_channels, selected_channels
from fdda_addon.recording.plan import RecordingSettings, read_sampled_rig
from fdda_addon.rig.reading import read_rig
from fdda_addon.scene.armature import Poser, clear_pose
from fdda_addon.scene.compatibility import animation_curves, select_bone
from fdda_addon.scene.scene_rig import SceneRig

from ..figure import SMILE, WAVE, add_smile, add_wave, build_figure, edit_bones, key_channel
from ..scene_state import fresh_elbow


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


def set_ik_limits(bone: bpy.types.PoseBone) -> None:
    bone.use_ik_limit_x, bone.ik_min_x, bone.ik_max_x = True, -0.5, 1.0


def limit_elsewhere(bone: bpy.types.PoseBone) -> None:
    limit(bone, space="WORLD", x=(0, 2))
    limit(bone, x=(0, 2)).mute = True


ANY = (-45, 45)
RANGES = {
    "default": (lambda bone: None, {0: ANY, 1: ANY, 2: ANY}),
    "limit": (lambda bone: limit(bone, x=(0.0, 2.0), z=(0.0, 0.0)), {0: (0, 114.592), 1: ANY}),
    "limit in another space, and muted": (limit_elsewhere, {0: ANY, 1: ANY, 2: ANY}),
    "IK limits": (lambda b: (set_ik_limits(b), setattr(b, "lock_ik_y", True)), {0: (-28.648, 57.296), 2: ANY}),
    "limit before IK limits": (lambda b: (set_ik_limits(b), limit(b, x=(0, 2))), {0: (0, 114.592), 1: ANY, 2: ANY}),
    "locks": (
        lambda b: (setattr(b, "lock_rotation", (True, False, True)), limit(b, x=(0, 2), y=(0, 1))),
        {1: (0, 57.296)},
    ),
    "moved by a constraint": (lambda bone: bone.constraints.new("COPY_ROTATION"), {}),
    "muted constraint": (
        lambda bone: setattr(bone.constraints.new("COPY_ROTATION"), "mute", True),
        {0: ANY, 1: ANY, 2: ANY},
    ),
}


@pytest.mark.parametrize("name", RANGES)
def test_ranges_of_rotation(fresh, name):
    change, expected = RANGES[name]
    change(fresh.armature_object.pose.bones["lower"])
    assert tuple(math.degrees(angle) for angle in DEFAULT_RANGE) == ANY
    assert ranges(fresh) == expected and ranges(fresh, "upper") == {0: ANY, 1: ANY, 2: ANY}


def test_limit_location(fresh):
    upper, lower = (fresh.armature_object.pose.bones[name] for name in ("upper", "lower"))
    limit(lower, "LIMIT_LOCATION", x=(-0.1, 0.2))
    assert lower.bone.use_connect and ranges(fresh, "lower", "location") == {}
    constraint = limit(upper, "LIMIT_LOCATION", x=(-0.1, 0.2), y=(0, 0.1), z=(0, 0))
    upper.lock_location[1] = True
    assert ranges(fresh, "upper", "location") == {0: (-0.1, 0.2)}
    constraint.use_max_x = False
    assert ranges(fresh, "upper", "location") == {}, "without an end it is no range"


def test_a_control_bone_with_a_range_is_sampled_and_no_joint_unless_it_is_a_parent(fresh):
    add_bones(fresh.armature_object, NewBone("control", (0, 0, 0.5), (0, 0, 0.7), is_deforming=False))
    control = fresh.armature_object.pose.bones["control"]
    assert ranges(fresh, "control") == {}
    control.lock_rotation[0] = False
    limit(control, x=(0, 1))
    assert ranges(fresh, "control")[0] == (0, 57.296)
    assert read_rig(fresh).joint_names == ("upper", "lower")
    edit_bones(fresh, lambda bones: setattr(bones["upper"], "parent", bones["control"]))
    rig = read_rig(fresh)
    assert rig.joint_names == ("control", "upper", "lower") and rig.parents.tolist() == [-1, 0, 1]


def test_nothing_to_sample(fresh):
    for bone in fresh.armature_object.pose.bones:
        bone.lock_rotation = (True, True, True)
    with pytest.raises(RigError, match=r"No bone of 'elbow_rig' may be sampled: all 2 are locked .* --poses 0"):
        sampled_channels(fresh, read_rig(fresh))


@pytest.mark.parametrize("mode", ["XYZ", "QUATERNION", "AXIS_ANGLE"])
def test_posing_in_every_rotation_mode(fresh, mode):
    upper, values = fresh.armature_object.pose.bones["upper"], (0.3, -0.5, 0.8, 0.25)
    upper.rotation_mode = mode
    rotations = [Channel("upper", "rotation", axis, -1, 1) for axis in range(3)]
    Poser(fresh, (*rotations, Channel("upper", "location", 2, -1, 1))).set(np.array(values))
    bpy.context.view_layer.update()
    expected = Matrix.Translation((0, 0, values[3])) @ Euler(values[:3]).to_matrix().to_4x4()
    np.testing.assert_allclose(np.array(upper.matrix_basis), np.array(expected), atol=1e-6)


@pytest.fixture
def waving() -> SceneRig:
    rig = build_figure()
    add_wave(rig)
    return rig


def wave() -> bpy.types.Action:
    return bpy.data.actions[WAVE]


def test_keyed_channels_that_move_are_measured(waving):
    found = measured_ranges(waving.armature_object, [wave()])
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


def test_several_actions_are_measured_together(waving):
    spine = waving.armature_object.pose.bones["spine"]
    waving.armature_object.animation_data.action = bow = bpy.data.actions.new("bow")
    key_channel(spine, 1, "rotation_euler", (0, 0, 0))
    key_channel(spine, 9, "rotation_euler", (-1, 0, 0))
    found = measured_ranges(waving.armature_object, [wave(), bow])
    assert found["spine", "rotation", 0] == pytest.approx((-1, 0.1), abs=1e-3)
    assert found["spine", "rotation", 1] == pytest.approx((0, 0.4), abs=1e-2)


def test_quaternion_rotations_are_measured_beyond_180_degrees(waving):
    arm = waving.armature_object.pose.bones["arm.L"]
    waving.armature_object.animation_data.action = spin = bpy.data.actions.new("spin")
    for frame in range(37):
        turn = Euler((math.radians(10 * frame), 0, 0)).to_quaternion()
        # Two quaternions represent the same rotation, and an action may contain either of them.
        key_channel(arm, frame, "rotation_quaternion", -turn if frame % 2 else turn)
    found = measured_ranges(waving.armature_object, [spin])
    assert found == {("arm.L", "rotation", 0): pytest.approx((0, 2 * math.pi), abs=1e-5)}


def test_angles_that_jump_by_360_degrees_do_not_widen_a_range(waving):
    spine = waving.armature_object.pose.bones["spine"]
    waving.armature_object.animation_data.action = baked = bpy.data.actions.new("baked")
    for frame, degrees in enumerate((-10, 10, 370, 380, 15)):
        key_channel(spine, frame, "rotation_euler", (0, math.radians(degrees), 0))
    found = measured_ranges(waving.armature_object, [baked])
    assert found == {("spine", "rotation", 1): pytest.approx((-math.radians(10), math.radians(20)), abs=1e-5)}


def test_keys_of_an_unused_rotation_mode_are_ignored(waving):
    waving.armature_object.pose.bones["arm.L"].rotation_mode = "XYZ"
    assert not any(bone == "arm.L" for bone, _, _ in measured_ranges(waving.armature_object, [wave()]))


def test_keyed_properties_are_measured_as_controls(waving):
    add_smile(waving, wave())
    arm = waving.armature_object.pose.bones["arm.R"]
    constraint = arm.constraints.new("LIMIT_SCALE")
    for frame, influence in ((1, 0.25), (9, 0.75)):
        constraint.influence = influence
        constraint.keyframe_insert("influence", frame=frame)
    found = {c.name: (c.low, c.high) for c in measured_controls(waving, [wave()])}
    assert found.pop('armature_object/pose.bones["arm.L"]["fist"]') == pytest.approx((0, 1), abs=1e-2)
    assert found.pop('armature_object/pose.bones["arm.R"].constraints["Limit Scale"].influence') == (0.25, 0.75)
    assert found.pop(f"shape_keys/{SMILE}") == pytest.approx((0, 0.8), abs=1e-6)
    assert not found


ARM = "arm.L"


@pytest.fixture
def figure() -> SceneRig:
    return build_figure()


def sampled(rig: SceneRig, *texts: str) -> tuple[Channel, ...]:
    texts = texts or tuple(f"action:{action.name}" for action in bpy.data.actions)
    return selected_channels(rig.armature_object, select_bones(rig, texts))


def channel_ranges(channels: tuple[Channel, ...], bone: str) -> dict:
    return {(c.kind, c.axis): (c.low, c.high) for c in channels if c.name == bone}


def test_limits_narrow_the_keyed_ranges_and_add_no_channels(figure):
    add_wave(figure)
    spine = figure.armature_object.pose.bones["spine"]
    limit(spine, "LIMIT_SCALE", x=(0.0, 2.0))
    limit(spine, "LIMIT_LOCATION", x=(-1.0, 0.01), z=(-1.0, 1.0))
    limit(spine, "LIMIT_ROTATION", x=(-1.5, 1.5), y=(0.0, 0.25), z=(-1.5, 1.5))
    channels = sampled(figure)
    found = channel_ranges(channels, "spine")
    assert found == {
        ("rotation", 0): pytest.approx((0, 0.1), abs=1e-3),
        ("rotation", 1): pytest.approx((0, 0.25)),
        ("location", 0): pytest.approx((0, 0.01)),
        ("location", 1): pytest.approx((0, 0.05), abs=1e-3),
    }
    # A bone that is also chosen by name moves in its whole range.
    both = channel_ranges(sampled(figure, "bone:spine", f"action:{WAVE}"), "spine")
    assert both["scale", 0] == (0, 2) and both["rotation", 0] == (-1.5, 1.5)


def test_muted_curves_of_an_action_are_not_sampled(figure):
    action = add_wave(figure)
    curves = {(c.data_path, c.array_index): c for c in animation_curves(action)}
    curves['pose.bones["spine"].rotation_euler', 1].mute = True
    curves['pose.bones["arm.L"]["fist"]', 0].mute = True
    assert ("rotation", 1) not in channel_ranges(sampled(figure), "spine")
    assert select_bones(figure, [f"action:{WAVE}"]).controls == ()


def test_a_channel_keyed_at_a_constant_value_keeps_the_value(figure):
    spine = figure.armature_object.pose.bones["spine"]
    figure.armature_object.animation_data_create().action = bpy.data.actions.new("lean")
    for frame, turn in ((1, -0.2), (9, 0.2)):
        key_channel(spine, frame, "rotation_euler", (0.75, turn, 0))
        key_channel(spine, frame, "location", (0, 0.5, 0))
    channels = sampled(figure)
    assert _format_channels(list(channels), True) == "locked  ±11°  locked"
    assert channel_ranges(channels, "spine") == {
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
