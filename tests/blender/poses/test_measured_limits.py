# SPDX-License-Identifier: GPL-3.0-or-later
"""Ranges are measured from actions and set as limits that do not change any pose of the rig."""

import math

import bpy
import numpy as np
import pytest
from mathutils import Euler

from fdda_addon.core.errors import RigError
from fdda_addon.poses.action_range import measured_controls, measured_ranges
from fdda_addon.poses.measured_limits import set_limits_from_actions
from fdda_addon.poses.motion_range import find_local_limit, location_ranges, rotation_ranges, scale_ranges
from fdda_addon.poses.sampling import sampled_channels
from fdda_addon.rig.reading import read_rig
from fdda_addon.scene.scene_rig import SceneRig, find_rig

from ..conftest import run
from ..figure import FRAMES, SMILE, WAVE, add_smile, add_wave, build_figure, edit_bones, key_channel
from ..scene_state import fresh_elbow


@pytest.fixture
def figure() -> SceneRig:
    rig = build_figure()
    add_wave(rig)
    return rig


def wave() -> bpy.types.Action:
    return bpy.data.actions[WAVE]


def poses(rig: SceneRig) -> np.ndarray:
    """Return the matrices of all bones in all frames of the action."""
    matrices = []
    for frame in range(1, FRAMES + 1):
        bpy.context.scene.frame_set(frame)
        matrices.append([np.array(bone.matrix) for bone in rig.armature_object.pose.bones])
    return np.array(matrices)


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


def test_limits_are_set_to_ranges_with_their_margin_and_change_no_pose(figure):
    before = poses(figure)
    limits = set_limits_from_actions(figure, [wave()], 0.5)
    assert all(not limit.reason_unset for limit in limits) and len(limits) == 9
    np.testing.assert_array_equal(poses(figure), before)
    bones = figure.armature_object.pose.bones
    # A range that includes the rest pose becomes IK limits. Any other range becomes a constraint with influence 0.
    spine, left, right = (rotation_ranges(bones[name]) for name in ("spine", "arm.L", "arm.R"))
    assert [r.source for r in spine] == ["IK", "IK", "DEFAULT"] and not find_local_limit(
        bones["spine"], "LIMIT_ROTATION"
    )
    assert (spine[1].low, spine[1].high) == pytest.approx((-0.2, 0.6), abs=5e-3)
    assert find_local_limit(bones["arm.L"], "LIMIT_ROTATION") is None and left[0].low == pytest.approx(-0.3, abs=5e-3)
    assert [r.source for r in right] == ["IK", "IK", "DEFAULT"]
    (moved,) = [c for c in bones["spine"].constraints]
    assert (moved.type, moved.influence, moved.owner_space) == ("LIMIT_LOCATION", 0, "LOCAL")
    assert location_ranges(bones["spine"])[1] == pytest.approx((-0.025, 0.075), abs=1e-3)
    assert scale_ranges(bones["arm.R"])[1] == pytest.approx((0.95, 1.15), abs=1e-3)
    channels = {(c.name, c.kind, c.axis): (c.low, c.high) for c in sampled_channels(figure, read_rig(figure))}
    for limit in limits:
        assert channels[limit.bone, limit.kind, limit.axis] == pytest.approx((limit.low, limit.high), abs=1e-6)


def test_a_range_that_excludes_the_rest_pose_becomes_a_constraint(figure):
    arm = figure.armature_object.pose.bones["arm.L"]
    arm.use_ik_limit_y, arm.ik_min_y, arm.ik_max_y = True, -0.4, 0.3
    before = poses(figure)
    set_limits_from_actions(figure, [wave()], 0.0)
    np.testing.assert_array_equal(poses(figure), before)
    ranges = rotation_ranges(arm)
    assert {r.source for r in ranges} == {"CONSTRAINT"} and find_local_limit(arm, "LIMIT_ROTATION").influence == 0
    assert (ranges[0].low, ranges[0].high) == pytest.approx((0.2, 1.2), abs=5e-3)
    assert (ranges[1].low, ranges[1].high) == pytest.approx((-0.4, 0.3)), "what was stated stays"
    assert not any(limit.axis == 1 for limit in set_limits_from_actions(figure, [wave()]) if limit.bone == "arm.L")
    assert len(arm.constraints) == 1, "the constraint is made once"
    right = figure.armature_object.pose.bones["arm.R"]
    assert rotation_ranges(right)[2].source == "DEFAULT", "what does not move is left alone without a constraint"


def test_an_axis_without_motion_gets_an_empty_range_beside_a_constraint(figure):
    set_limits_from_actions(figure, [wave()], 0.0)
    still = rotation_ranges(figure.armature_object.pose.bones["arm.L"])[1]
    assert (still.low, still.high, still.source, still.moves) == (0, 0, "CONSTRAINT", False)


def test_a_bone_that_ik_may_move_gets_no_ik_limits(figure):
    figure.armature_object.pose.bones["arm.R"].constraints.new("IK").influence = 0
    set_limits_from_actions(figure, [wave()])
    for bone in figure.armature_object.pose.bones:
        assert not (bone.use_ik_limit_x or bone.use_ik_limit_y), bone.name
        assert rotation_ranges(bone)[0].source == "CONSTRAINT"


def test_active_limits_are_kept_and_clip_the_range():
    elbow = fresh_elbow()
    lower = elbow.armature_object.pose.bones["lower"]
    held = lower.constraints[0]
    limits = {
        (limit.bone, limit.axis): limit for limit in set_limits_from_actions(elbow, [bpy.data.actions["elbow_wave"]])
    }
    assert (held.influence, held.min_x, held.max_x) == (1, 0, pytest.approx(math.radians(120)))
    assert (limits["lower", 0].low, limits["lower", 0].high) == pytest.approx((0, math.radians(110)), abs=1e-3)
    assert [c.influence for c in lower.constraints] == [0, 1]
    assert rotation_ranges(lower)[0].high == pytest.approx(math.radians(110), abs=1e-3)
    assert not rotation_ranges(lower)[1].moves, "the range 0 to 0 that it had"
    held.max_x = -0.4
    held.min_x = -0.5
    left = {(x.bone, x.axis): x.reason_unset for x in set_limits_from_actions(elbow, [bpy.data.actions["elbow_wave"]])}
    assert left["lower", 0] == "held by its limit, left so"


def test_locked_axes_and_connected_bones_get_no_limits(figure):
    bones = figure.armature_object.pose.bones
    bones["spine"].lock_rotation[1] = bones["spine"].lock_location[0] = bones["arm.R"].lock_ik_x = True
    arm = bones["arm.L"]
    key_channel(arm, 1, "location", (0, 0, 0))
    key_channel(arm, 9, "location", (0, 1, 0))

    def connect(edited):
        edited["arm.L"].head = edited["spine"].tail
        edited["arm.L"].use_connect = True

    edit_bones(figure, connect)
    left = {
        (x.bone, x.kind, x.axis): x.reason_unset for x in set_limits_from_actions(figure, [wave()]) if x.reason_unset
    }
    assert left == {
        ("spine", "rotation", 1): "locked, left so",
        ("spine", "location", 0): "locked, left so",
        ("arm.R", "rotation", 0): "locked, left so",
        ("arm.L", "location", 1): "connected, cannot move",
    }
    assert bones["spine"].lock_rotation[1] and not bones["spine"].use_ik_limit_y and bones["arm.R"].lock_ik_x


def test_actions_of_another_rig_are_refused(figure):
    other = bpy.data.actions.new("other")
    with pytest.raises(RigError, match=r"The actions \('other'\) move no bone of 'figure_rig'; choose actions of this"):
        set_limits_from_actions(figure, [other])


def test_linked_rigs_are_refused_and_overrides_are_accepted(figure, tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "figure.blend"))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with bpy.data.libraries.load(str(tmp_path / "figure.blend"), link=True) as (_, linked):
        linked.objects, linked.actions = ["body", "figure_rig"], [WAVE]
    for linked_object in bpy.data.objects:
        bpy.context.scene.collection.objects.link(linked_object)
    with pytest.raises(RigError, match="'figure_rig' is linked and its limits belong to another file; set them there"):
        set_limits_from_actions(find_rig(), [wave()])
    override = bpy.data.objects["figure_rig"].override_create(remap_local_usages=True)
    set_limits_from_actions(SceneRig(bpy.data.objects["body"], override), [wave()])
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shot.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "shot.blend"))
    (own,) = [o for o in bpy.data.objects if o.override_library is not None]
    assert location_ranges(own.pose.bones["spine"])[1] == pytest.approx((-0.005, 0.055), abs=1e-3)
    assert rotation_ranges(own.pose.bones["arm.L"])[0].low == pytest.approx(0.1, abs=2e-2)


def test_the_limits_verb_sets_and_prints_limits(tmp_path, capsys):
    build_figure()
    add_wave(find_rig())
    source, out = tmp_path / "figure.blend", tmp_path / "limited.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(source))
    assert run("limits", source, out, "--action", WAVE, "--margin", "0") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == f"{out}: set the limits of 3 bones of 'figure_rig'"
    assert "spine: moves X 0.0 to 20.0 mm, moves Y 0.0 to 49.9 mm, turns X 0.0 to 5.7°, turns Y 0.0 to 22.9°" in lines
    assert "arm.R: turns X 0.0 to 17.1°, turns Y 0.0 to 5.7°, scales Y 1.00 to 1.10" in lines
    bpy.ops.wm.open_mainfile(filepath=str(out))
    assert location_ranges(find_rig().armature_object.pose.bones["spine"])[1] == pytest.approx((0, 0.05), abs=1e-3)
    assert run("limits", source, out, "--action", "nod") == 1
    assert f"The file has no action 'nod'; its actions: '{WAVE}'." in capsys.readouterr().err
    assert run("limits", source, out, "--action", WAVE, "--margin", "-1") == 2
    assert "--margin must be 0 to 10." in capsys.readouterr().err


def test_the_limits_button_uses_the_checked_actions(figure):
    bpy.context.view_layer.objects.active = figure.mesh_object
    with pytest.raises(RuntimeError, match="No action is checked; check the actions under Also Record Actions"):
        bpy.ops.fdda.limits_from_actions()
    wave().fdda.record = True
    assert bpy.ops.fdda.limits_from_actions(margin=0.5) == {"FINISHED"}
    assert rotation_ranges(figure.armature_object.pose.bones["spine"])[1].low == pytest.approx(-0.2, abs=5e-3)
