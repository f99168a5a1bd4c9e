# SPDX-License-Identifier: GPL-3.0-or-later
"""`--bones-to-pose remix`: random poses that combine the limbs of recorded actions."""

import bpy
import numpy as np
import pytest

from blend_fixtures.characters import control_rigs
from blend_fixtures.characters.base import add_key, drive
from fdda_addon.core.errors import RigError
from fdda_addon.core.mathematics.poses import CONTROL, LOCATION, ROTATION_VECTOR
from fdda_addon.core.recording.index import read_index, read_info
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.panels import checks
from fdda_addon.poses.motion_range import clear_rotation_range, set_rotation_range
from fdda_addon.poses.remix import choose_bones, read_remix, remixed_actions
from fdda_addon.properties.recording_options import describe_chosen_bones, recording_settings
from fdda_addon.recording.plan import RecordingSettings, make_pose_sampler, read_sampled_rig
from fdda_addon.scene.armature import Poser, clear_pose
from fdda_addon.scene.blend_file import save_copy
from fdda_addon.scene.compatibility import curves_of_slot
from fdda_addon.scene.scene_rig import SceneRig, find_rig

from ..conftest import run
from ..figure import FRAMES, add_wave, build_figure, edit_bones, key_channel

WAVE, STILL, TURN = "wave", "one frame", "turn the dial"


@pytest.fixture
def waving(rig: SceneRig) -> SceneRig:
    """The elbow with an action that rotates both bones, moves the upper one and turns a property."""
    armature_object = rig.armature_object
    for action in list(bpy.data.actions):
        bpy.data.actions.remove(action)
    upper, lower = armature_object.pose.bones["upper"], armature_object.pose.bones["lower"]
    armature_object.animation_data_create().action = bpy.data.actions.new(WAVE)
    armature_object["dial"] = 0.0
    armature_object.id_properties_ui("dial").update(min=-1.0, max=1.0)
    upper.rotation_mode, upper.lock_rotation = "QUATERNION", (False, True, False)
    for frame in range(1, 41):
        upper.rotation_quaternion = np.array([1.0, 0.3 * np.sin(frame), 0.0, 0.2 * np.cos(frame)])
        upper.location[2] = frame / 1000
        lower.rotation_euler[0] = frame / 40
        armature_object["dial"] = np.cos(frame)
        for owner, path in (
            *((upper, path) for path in ("rotation_quaternion", "location")),
            (lower, "rotation_euler"),
            (armature_object, '["dial"]'),
        ):
            owner.keyframe_insert(path, frame=frame)
    armature_object.animation_data.action = None
    bpy.data.actions[WAVE].use_fake_user = True
    clear_pose(armature_object)
    return rig


def test_remixed_frames_show_the_pose_of_the_action(waving):
    """Without noise, the channels of a frame set the rotation, location and property that the action shows."""
    action = bpy.data.actions[WAVE]
    remix = read_remix(waving, [action])
    kinds = {(channel.name, channel.kind, channel.axis) for channel in remix.channels}
    assert kinds == {
        *((bone, ROTATION_VECTOR, axis) for bone in ("upper", "lower") for axis in range(3)),
        ("upper", LOCATION, 2),
        ('armature_object/["dial"]', CONTROL, 0),
    }
    assert remix.values.shape == (40, 8)
    # The lower bone is the only child of the upper one, so they are one limb; the property is another.
    assert remix.limbs.tolist() == [0] * 7 + [remix.limbs[-1]] and remix.limbs[-1] != 0
    assert remix.has_noise.tolist() == [True, False, True, False, True, True, True, False]
    armature_object, bones = waving.armature_object, waving.armature_object.pose.bones
    for frame in (1, 17, 40):
        armature_object.animation_data.action = action
        bpy.context.scene.frame_set(frame)
        expected = [np.array(bones[name].matrix_basis) for name in ("upper", "lower")]
        dial = armature_object["dial"]
        armature_object.animation_data.action = None
        clear_pose(armature_object)
        Poser(waving, remix.channels).set(remix.values[frame - 1])
        for matrix, name in zip(expected, ("upper", "lower"), strict=True):
            assert np.array(bones[name].matrix_basis) == pytest.approx(matrix, abs=1e-5)
        assert armature_object["dial"] == pytest.approx(dial)


@pytest.mark.parametrize(("roll", "is_local"), [(0.0, True), (0.7, True), (0.7, False)])
def test_mirror_images_of_the_frames_follow_where_bones_have_two_sides(roll, is_local):
    """Whatever the roll of the bones and the space of locations."""
    figure = build_figure()
    armature_object = figure.armature_object
    edit_bones(figure, lambda bones: setattr(bones["arm.L"], "roll", bones["arm.L"].roll + roll))
    for bone in armature_object.data.bones:
        bone.use_local_location = is_local
    action = add_wave(figure)
    key_channel(armature_object.pose.bones["arm.L"], 1, "location", (0.03, 0.02, 0.04))
    armature_object.pose.bones["arm.R"]["fist"] = 0.25
    armature_object.pose.bones["arm.R"].keyframe_insert('["fist"]', frame=1)
    left, sides = "arm.L", ("spine", "arm.L", "arm.R")
    remix = read_remix(figure, [action])
    assert len(remix.values) == 2 * FRAMES
    fists = {channel.name.split('"')[1]: n for n, channel in enumerate(remix.channels) if "fist" in channel.name}
    columns = [fists[left], fists["arm.R"]]
    assert remix.values[FRAMES:, columns] == pytest.approx(remix.values[:FRAMES, columns[::-1]])
    assert (remix.values[:FRAMES, fists["arm.R"]] == 0.25).all()
    heads_and_tails = []
    for index in (9, FRAMES + 9):
        armature_object.animation_data.action = None
        clear_pose(armature_object)
        Poser(figure, remix.channels).set(remix.values[index])
        bpy.context.view_layer.update()
        ends = [(armature_object.pose.bones[name].head, armature_object.pose.bones[name].tail) for name in sides]
        heads_and_tails.append(np.array(ends))
    frame, image = heads_and_tails
    assert np.abs(frame[1] - frame[2] * [-1, 1, 1]).max() > 0.1
    np.testing.assert_allclose(image, frame[[0, 2, 1]] * [-1, 1, 1], atol=1e-6)
    edit_bones(figure, lambda bones: setattr(bones[left], "head", (0.2, 0.1, 0.9)))
    assert len(read_remix(figure, [action]).values) == FRAMES, "the bones are no mirror images"


def test_a_bone_without_another_side_repeats_its_frames_beside_mirrored_ones():
    figure = build_figure()
    edit_bones(figure, lambda bones: setattr(bones.new("tool.R"), "tail", (0.0, 0.0, 0.3)))
    edit_bones(figure, lambda bones: setattr(bones["tool.R"], "head", (-0.5, 0.0, 0.0)))
    action = add_wave(figure)
    tool = figure.armature_object.pose.bones["tool.R"]
    key_channel(tool, 1, "location", (0.0, 0.0, 0.0))
    key_channel(tool, FRAMES, "location", (0.3, 0.2, 0.1))
    remix = read_remix(figure, [action])
    assert len(remix.values) == 2 * FRAMES
    columns = [n for n, channel in enumerate(remix.channels) if channel.name == "tool.R"]
    assert np.array_equal(remix.values[FRAMES:, columns], remix.values[:FRAMES, columns])


def test_frames_of_an_action_that_does_not_key_a_bone_have_its_rest_pose(waving):
    action = bpy.data.actions.new("nod")
    waving.armature_object.animation_data.action = action
    lower = waving.armature_object.pose.bones["lower"]
    for frame in (1, 10):
        lower.rotation_euler[0] = frame / 10
        lower.keyframe_insert("rotation_euler", frame=frame)
    remix = read_remix(waving, [action, bpy.data.actions[WAVE]])
    upper = [n for n, channel in enumerate(remix.channels) if channel.name == "upper"]
    assert not remix.values[:10, upper].any() and remix.values[10:, upper].any(axis=1).all()


def test_a_recording_remixes_its_actions(waving, tmp_path):
    save_copy(tmp_path / "rig.blend")
    options = ("--bones-to-pose", "remix", "--action", WAVE, "--poses", 30, "--seed", 4)
    assert run("record", tmp_path / "rig.blend", tmp_path / "recording", *options) == 0
    recording = read_recording(tmp_path / "recording")
    random_source, action_source, _ = recording.info.sampling.sources
    assert (random_source.kind, random_source.name, random_source.poses) == ("random", "remix", 30)
    assert action_source.poses == 40
    settings = RecordingSettings(poses=30, seed=4, bones_to_pose=("remix",), actions=(WAVE,))
    rig = find_rig()
    _, channels = read_sampled_rig(rig, settings)
    sampler = make_pose_sampler(rig, settings)
    assert sampler.remix is not None and sampler.draw_pose(channels, 2).shape == (len(channels),)
    assert np.ptp(np.array(recording.pose_matrices[:30]), axis=0).max() > 0.5


@pytest.mark.parametrize(("bones", "names"), [((), ("pout",)), (("collection:Controls",), ("pout", "corrective"))])
def test_keys_and_bones_that_act_through_keys_alone_may_rest(bones, names):
    """A joint that also drives a key is none of them; while it is not posed, the key is set without its driver."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    control_rigs.face_slider()
    scene_rig = find_rig()
    add_key(scene_rig.mesh_object, "pout", lambda points: points * 1.01)
    corrective = add_key(scene_rig.mesh_object, "corrective", lambda points: points * 0.99)
    drive(corrective, "value", scene_rig.armature_object, 'pose.bones["upper"].rotation_euler[0]')
    _, channels = read_sampled_rig(scene_rig, RecordingSettings(bones_to_pose=bones))
    assert {channel.name for channel in channels if channel.is_key} == {
        "slider",
        *(f'shape_keys/key_blocks["{name}"].value' for name in names),
    }


def remove_limits(scene_rig: SceneRig) -> None:
    for bone in scene_rig.armature_object.pose.bones:
        for axis in range(3):
            clear_rotation_range(bone, axis)


def test_without_recorded_actions_limbs_come_from_all_that_move_bones(waving):
    """An action that only an Action constraint plays is no motion of the character."""
    constraint = waving.armature_object.pose.bones["lower"].constraints.new("ACTION")
    constraint.action = bpy.data.actions[WAVE].copy()
    constraint.action.use_fake_user = True
    assert remixed_actions(waving, []) == (bpy.data.actions[WAVE],)
    # What another character of the file plays may not fit this one.
    other = waving.armature_object.copy()
    bpy.context.collection.objects.link(other)
    other.animation_data_create().action = bpy.data.actions[WAVE].copy()
    other.animation_data.action_slot = other.animation_data.action.slots[0]
    assert remixed_actions(waving, []) == (bpy.data.actions[WAVE],)
    # Limits of the rig are no guess.
    assert choose_bones(waving, []) == ()
    remove_limits(waving)
    assert choose_bones(waving, []) == ("remix",)
    np.testing.assert_array_equal(read_remix(waving, []).values, read_remix(waving, [bpy.data.actions[WAVE]]).values)
    bpy.data.actions.remove(bpy.data.actions[WAVE])
    assert choose_bones(waving, []) == ()
    with pytest.raises(RigError, match="There is no pose to remix: no action moves a bone of 'elbow_rig'"):
        read_sampled_rig(waving, RecordingSettings(bones_to_pose=("remix",)))


def test_bones_that_actions_leave_at_rest_move_within_their_limits(waving):
    """Without limits they stay at rest: ±45° about each axis would be far from any motion of the character."""
    action = bpy.data.actions[WAVE]
    curves = curves_of_slot(action, action.slots[0])
    for curve in [curve for curve in curves if '"lower"' in curve.data_path]:
        action.layers[0].strips[0].channelbags[0].fcurves.remove(curve)
    settings = RecordingSettings(bones_to_pose=("remix",), actions=(WAVE,))
    ranges = [(c.axis, c.low, c.high) for c in read_sampled_rig(waving, settings)[1] if c.name == "lower"]
    assert [axis for axis, _, _ in ranges] == [0]
    remove_limits(waving)
    assert "lower" not in {channel.name for channel in read_sampled_rig(waving, settings)[1]}


def test_an_action_that_moves_no_bone_is_refused(waving):
    bpy.data.actions.new("still")
    with pytest.raises(RigError, match="There is no pose to remix: 'still' moves no bone of 'elbow_rig'"):
        read_sampled_rig(waving, RecordingSettings(bones_to_pose=("remix",), actions=("still",)))


def add_actions_without_motion(armature_object: bpy.types.Object) -> None:
    """Add an action of one frame, and one that moves a property and keeps a bone where it is."""
    for name, frames in ((STILL, [1]), (TURN, [1, 10])):
        armature_object.animation_data.action = bpy.data.actions.new(name)
        for frame in frames:
            armature_object.pose.bones["lower"].rotation_euler[0] = 0.5
            armature_object.pose.bones["lower"].keyframe_insert("rotation_euler", frame=frame)
            if name == TURN:
                armature_object["dial"] = frame / 10
                armature_object.keyframe_insert('["dial"]', frame=frame)
        armature_object.animation_data.action = None
        bpy.data.actions[name].use_fake_user = True
    clear_pose(armature_object)


def test_a_single_pose_is_refused(waving):
    add_actions_without_motion(waving.armature_object)
    with pytest.raises(RigError, match="There is only one pose to remix: nothing of 'elbow_rig' moves in 'one frame'"):
        read_sampled_rig(waving, RecordingSettings(bones_to_pose=("remix",), actions=(STILL,)))
    read_sampled_rig(waving, RecordingSettings(bones_to_pose=("remix",), actions=(STILL, WAVE)))


def test_the_sidebar_chooses_limbs_from_actions(waving, tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "waving.blend"))
    settings, action = waving.mesh_object.fdda.settings, bpy.data.actions[WAVE]
    assert recording_settings(waving).bones_to_pose == ()
    assert describe_chosen_bones(waving) == "Random poses move the deforming bones and all bones with limits."
    action.fdda.record = True
    assert describe_chosen_bones(waving) == "Random poses combine limbs from 1 recorded action."
    assert {channel.kind for channel in checks.check_now(waving).channels} == {ROTATION_VECTOR, LOCATION, CONTROL}
    # Frames of actions alone are recorded as before.
    settings.poses = 0
    assert (settings.auto_poses, recording_settings(waving).bones_to_pose) == (False, ())
    settings.poses, action.fdda.record = 5, False
    remove_limits(waving)
    assert recording_settings(waving).bones_to_pose == ("remix",)
    assert describe_chosen_bones(waving) == "Random poses combine limbs from 1 action, which is not recorded itself."
    settings.bones_to_pose = "WEIGHTS"
    assert recording_settings(waving).bones_to_pose == ()
    # What the user chooses holds for a rig with limits too.
    set_rotation_range(waving.armature_object.pose.bones["lower"], 0, 0.0, 2.0)
    settings.bones_to_pose = "REMIX"
    assert recording_settings(waving).bones_to_pose == ("remix",)
    assert describe_chosen_bones(waving) == "Random poses combine limbs from 1 action, which is not recorded itself."


@pytest.mark.parametrize(
    "options, source, sentence",
    [
        (["--action", WAVE, "--action", STILL], "remix", "combine limbs from 2 recorded actions."),
        ([], "", "bones with limits."),
        (["--bones-to-pose", "deforming"], "", ""),
        # There is no motion of bones to combine.
        (["--action", TURN], "", "bones with limits."),
        (["--action", WAVE, "--poses", 0], None, ""),
    ],
)
def test_the_verb_chooses_limbs_from_actions(waving, tmp_path, capsys, options, source, sentence):
    add_actions_without_motion(waving.armature_object)
    path = tmp_path / "rig.blend"
    save_copy(path)
    poses = [] if "--poses" in options else ["--poses", 12]
    assert run("record", path, tmp_path / "recording", *poses, *options) == 0
    output = capsys.readouterr().out
    assert sentence in output if sentence else "Random poses" not in output
    sources = read_info(read_index(tmp_path / "recording")).sampling.sources
    assert next((s.name for s in sources if s.kind == "random"), None) == source
