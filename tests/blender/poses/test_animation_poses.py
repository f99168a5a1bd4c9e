# SPDX-License-Identifier: GPL-3.0-or-later
"""Recording and evaluation of actions and NLA strips, also mirrored, and of shape keys that actions animate."""

import json
from dataclasses import replace

import bpy
import numpy as np
import pytest

from fdda_addon.core.errors import RecordingError, RigError
from fdda_addon.core.progress import run_job
from fdda_addon.core.recording.reader import Recording, read_recording
from fdda_addon.evaluation.run import evaluate
from fdda_addon.evaluation.settings import EvaluationSettings
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.recording.run import record
from fdda_addon.scene.scene_rig import SceneRig

from ..conftest import Trained, build_and_train, evaluated_positions, run
from ..figure import ARM_REACH, FRAMES, SMILE, WAVE, add_smile, add_wave, build_figure, edit_bones, key_channel
from ..refusals import file_contents
from ..scene_state import assert_same_state, drain, scene_state


@pytest.fixture
def figure() -> SceneRig:
    rig = build_figure()
    add_wave(rig)
    return rig


def record_and_read(rig: SceneRig, path, **settings) -> Recording:
    """Record a rig and read the recording; it has no random poses unless the settings ask for them."""
    drain(record(rig, path, RecordingSettings(**{"poses": 0, "influence_poses": 2, **settings})))
    return read_recording(path)


def positions_of(recording: Recording) -> np.ndarray:
    """Return the recorded positions (N, V, 3) of all poses but those that move one input alone."""
    return np.delete(recording.positions, recording.info.alone_poses, axis=0)


def positions_in_frames(rig: SceneRig, frames) -> np.ndarray:
    """Return the positions (F, V, 3) of the rig in frames of its own animation."""
    positions_by_frame = []
    for frame in frames:
        bpy.context.scene.frame_set(frame)
        positions_by_frame.append(evaluated_positions(rig.mesh_object))
    return np.array(positions_by_frame)


def mirrored(rig: SceneRig, points: np.ndarray) -> np.ndarray:
    """Mirror positions (F, V, 3) across X; each vertex gets the position of the vertex on the other side."""
    rest = np.array([vertex.co[:] for vertex in rig.mesh_object.data.vertices])
    distances = np.linalg.norm(rest[:, None] * [-1, 1, 1] - rest[None], axis=-1)
    assert distances.min(axis=1).max() < 1e-6
    return points[:, distances.argmin(axis=1)] * [-1, 1, 1]


def add_strips(rig: SceneRig, action: bpy.types.Action, start: int = 40, name: str = "swing") -> bpy.types.NlaStrip:
    """Add an NLA strip with an action, above a strip that rotates the spine."""
    animation = rig.armature_object.animation_data
    animation.action = lean_action = bpy.data.actions.new("lean")
    key_channel(rig.armature_object.pose.bones["spine"], 1, "rotation_euler", (0, 0, 0.3))
    below = animation.nla_tracks.new()
    below.strips.new("lean", 1, lean_action).frame_end = 200
    above = animation.nla_tracks.new()
    above.name = "above"
    strip = above.strips.new("swing", start, action)
    strip.name, strip.blend_type = name, "COMBINE"
    animation.action = None
    return strip


@pytest.mark.parametrize(("old", "new"), [(100, 200), (100, 30)])
def test_time_stretching_does_not_change_the_recorded_frames(figure, tmp_path, old, new):
    shown = positions_in_frames(figure, range(1, FRAMES + 1))
    strip_recording_options = {"strips": ("swing",), "poses": 3, "extra_inputs": ("Smile",)}
    add_strips(figure, bpy.data.actions[WAVE])
    expected = positions_of(record_and_read(figure, tmp_path / "expected", **strip_recording_options))
    render = bpy.context.scene.render
    render.frame_map_old, render.frame_map_new = old, new
    bpy.context.scene.frame_set(7)
    before = scene_state(figure)
    recording = record_and_read(figure, tmp_path / "action", actions=(WAVE,))
    np.testing.assert_allclose(positions_of(recording), shown, atol=1e-5)
    recording = record_and_read(figure, tmp_path / "strip", **strip_recording_options)
    np.testing.assert_allclose(positions_of(recording), expected, atol=1e-5)
    assert_same_state(before, scene_state(figure))
    assert (render.frame_map_old, render.frame_map_new) == (old, new)


def test_a_recorded_strip_includes_the_tracks_below_it(figure, tmp_path):
    add_strips(figure, bpy.data.actions[WAVE])
    shown = positions_in_frames(figure, range(40, 40 + FRAMES))
    other_action = bpy.data.actions.new("other")
    figure.armature_object.animation_data.action = other_action
    key_channel(figure.armature_object.pose.bones["arm.R"], 1, "rotation_quaternion", (0.5, 0.5, 0.5, 0.5))
    before = scene_state(figure)
    recording = record_and_read(figure, tmp_path / "recording", strips=("swing",))
    assert_same_state(before, scene_state(figure))
    source, _ = recording.info.sampling.sources
    assert (source.kind, source.poses, source.name, source.frames) == ("strip", FRAMES, "swing", (40, 1))
    np.testing.assert_allclose(positions_of(recording), shown, atol=1e-5)
    action_recording = record_and_read(figure, tmp_path / "action", actions=(WAVE,))
    assert np.abs(positions_of(action_recording) - shown).max() > 0.05, "the strip includes the track below"


def test_mirrored_frames_are_the_mirror_images(figure, tmp_path):
    shown = positions_in_frames(figure, range(1, FRAMES + 1))
    before = scene_state(figure)
    recording = record_and_read(figure, tmp_path / "recording", actions=(WAVE,), mirror=True)
    assert_same_state(before, scene_state(figure))
    assert [(s.kind, s.poses, s.name, s.frames) for s in recording.info.sampling.sources[:-1]] == [
        ("action", FRAMES, WAVE, (1, 1)),
        ("mirrored", FRAMES, WAVE, (1, 1)),
    ]
    recorded_positions = positions_of(recording)
    np.testing.assert_allclose(recorded_positions[:FRAMES], shown, atol=1e-5)
    np.testing.assert_allclose(recorded_positions[FRAMES:], mirrored(figure, shown), atol=1e-5)
    assert np.abs(recorded_positions[FRAMES:] - recorded_positions[:FRAMES]).max() > 0.1


def test_mirrored_strips_are_the_mirror_images(figure, tmp_path):
    add_strips(figure, bpy.data.actions[WAVE])
    shown = positions_in_frames(figure, range(40, 40 + FRAMES))
    recording = record_and_read(figure, tmp_path / "recording", strips=("swing",), mirror=True)
    np.testing.assert_allclose(positions_of(recording)[FRAMES:], mirrored(figure, shown), atol=1e-5)


def test_mirroring_exchanges_controls_of_left_and_right_bones(figure, tmp_path):
    """The left control is keyed, and the right control is constant."""
    figure.armature_object.pose.bones["arm.R"]["fist"] = 0.25
    names = [f'armature_object/pose.bones["arm.{side}"]["fist"]=0:1' for side in "LR"]
    before = scene_state(figure)
    recording = record_and_read(figure, tmp_path / "recording", actions=(WAVE,), mirror=True, extra_inputs=tuple(names))
    assert_same_state(before, scene_state(figure))
    controls = np.array(recording.controls[: 2 * FRAMES])
    assert np.ptp(controls[:FRAMES, 0]) > 0.9 and (controls[:FRAMES, 1] == 0.25).all()
    np.testing.assert_array_equal(controls[FRAMES:], controls[:FRAMES, ::-1])


def test_mirroring_refuses_asymmetric_rigs(figure, tmp_path):
    def refusal() -> str:
        with pytest.raises(RigError) as error:
            record_and_read(figure, tmp_path / "recording", actions=(WAVE,), mirror=True)
        assert not (tmp_path / "recording").exists()
        return str(error.value)

    bones = figure.armature_object.pose.bones
    bones["arm.R"].rotation_mode = "XYZ"
    differ = "the bones 'arm.L' and 'arm.R' differ in place, roll, direction or rotation mode; symmetrize the armature"
    assert differ in refusal()
    bones["arm.R"].rotation_mode = "QUATERNION"
    edit_bones(figure, lambda edited: setattr(edited["arm.R"], "roll", edited["arm.R"].roll + 0.2))
    assert differ in refusal()
    edit_bones(figure, lambda edited: edited["arm.R"].align_roll((0, -1, 0)))
    edit_bones(figure, lambda edited: setattr(edited["arm.R"], "tail", (-ARM_REACH - 0.01, 0, 0.9)))
    assert differ in refusal()
    edit_bones(figure, lambda edited: edited.remove(edited["arm.R"]))
    assert "there is no bone 'arm.R' for 'arm.L'; add it, or leave mirroring out." in refusal()
    edit_bones(figure, lambda edited: setattr(edited["spine"], "head", (0.1, 0, 0)))
    assert "the bone 'spine' differs from its mirror image; bring it into the middle" in refusal()


def test_mirroring_without_animation_is_refused(figure, tmp_path):
    with pytest.raises(RecordingError, match="nothing to mirror: no action and no strip; give --action or --strip"):
        record_and_read(figure, tmp_path / "recording", poses=3, mirror=True)


def test_strips_that_are_missing_or_muted_are_refused(figure, tmp_path):
    strip = add_strips(figure, bpy.data.actions[WAVE])
    with pytest.raises(RigError, match=r"NLA of 'figure_rig' has no strip 'jump'; its strips: 'lean', 'swing'\."):
        record_and_read(figure, tmp_path / "recording", strips=("jump",))
    strip.mute = True
    with pytest.raises(RigError, match="'swing' of 'figure_rig' is muted and shows nothing; unmute it and its track"):
        record_and_read(figure, tmp_path / "recording", strips=("swing",))


def test_an_action_with_curves_for_shape_keys_moves_them(figure, tmp_path):
    wave, keys = bpy.data.actions[WAVE], figure.mesh_object.data.shape_keys
    add_smile(figure, wave)
    keys.animation_data.action = own_action = bpy.data.actions.new("own")
    keys.key_blocks["Smile"].value = 0.9
    keys.keyframe_insert(SMILE, frame=1)
    bpy.context.view_layer.update()
    keys.key_blocks["Smile"].value = 0.3
    slot = keys.animation_data.action_slot.identifier
    before = scene_state(figure)
    for controls in ((), ("Smile",)):
        recording = record_and_read(
            figure, tmp_path / f"recording{len(controls)}", actions=(WAVE,), extra_inputs=controls
        )
        still_recording = record_and_read(figure, tmp_path / f"still{len(controls)}", actions=("own",))
        assert (keys.animation_data.action, keys.animation_data.action_slot.identifier) == (own_action, slot)
        assert keys.key_blocks["Smile"].value == pytest.approx(0.3)
        middle_index = FRAMES // 2 - 1
        offsets = np.linalg.norm(positions_of(recording) - positions_of(still_recording)[0], axis=-1)
        assert offsets[middle_index].max() > 0.02
        if controls:
            values = np.delete(recording.controls[:, 0], recording.info.alone_poses)
            assert values[0] == 0 and values[middle_index] == pytest.approx(0.8) and values[-1] == 0
    assert_same_state({**before, "positions": ()}, {**scene_state(figure), "positions": ()})


def test_a_renamed_character_uses_the_slot_that_moves_bones(figure, tmp_path):
    """No slot has the name of the armature, so the slot with curves of bones is used, not an empty slot."""
    wave = bpy.data.actions[WAVE]
    expected = positions_of(record_and_read(figure, tmp_path / "own", actions=(WAVE,)))
    figure.armature_object.name = "someone"
    wave.slots.new(id_type="OBJECT", name="table")
    np.testing.assert_array_equal(positions_of(record_and_read(figure, tmp_path / "other", actions=(WAVE,))), expected)


def test_random_controls_are_reset_before_actions(figure, tmp_path):
    """Otherwise a recording that is resumed in an action would differ from an uninterrupted one."""
    name = 'armature_object/pose.bones["arm.R"]["fist"]'
    figure.armature_object.pose.bones["arm.R"]["fist"] = 0.5
    recording = record_and_read(figure, tmp_path / "recording", poses=5, actions=(WAVE,), extra_inputs=(f"{name}=0:1",))
    values = np.delete(recording.controls, recording.info.alone_poses, axis=0)
    values = values[:, [c.name for c in recording.rig.controls].index(name)]
    assert np.ptp(values[:5]) > 0 and (values[5:] == 0.5).all()


def test_resumed_recordings_have_the_same_bytes_and_restore_the_scene(figure, tmp_path):
    """Recording stops during the random poses, those beyond the limits, the action, and the mirrored action."""
    add_strips(figure, bpy.data.actions[WAVE])
    limits = [bone.constraints.new("LIMIT_ROTATION") for bone in figure.armature_object.pose.bones]
    for constraint in limits:
        constraint.owner_space, constraint.use_limit_x, constraint.max_x = "LOCAL", True, 0.5
    name = 'armature_object/pose.bones["arm.R"]["fist"]=0:1'
    settings = {"poses": 12, "overshoot": 2.0, "actions": (WAVE,), "strips": ("swing",), "mirror": True}
    settings = RecordingSettings(**settings, influence_poses=1, extra_inputs=(name,))
    before = scene_state(figure)
    drain(record(figure, tmp_path / "whole", settings))
    for stop_pose in (5, 10, 30, 57):
        resumed = tmp_path / f"resumed from {stop_pose}"
        steps = record(figure, resumed, settings)
        for step in steps:
            if step.stage == "poses" and step.done == stop_pose:
                steps.close()
        assert_same_state(before, scene_state(figure))
        assert not any(constraint.mute for constraint in limits)
        index = json.loads((resumed / "recording.json").read_text())
        assert stop_pose <= index["complete"] < index["poses"] and index["poses"] > 12 + 4 * FRAMES
        drain(record(figure, resumed, replace(settings, resume=True)))
        assert file_contents(resumed) == file_contents(tmp_path / "whole")


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Trained:
    """The figure with a model that was trained on its action alone."""

    def build() -> None:
        rig = build_figure()
        add_strips(rig, add_wave(rig))

    options = ("--poses", 0, "--action", WAVE, "--mirror")
    return build_and_train(tmp_path_factory.mktemp("figure"), build, *options, training=("--passes", 30))


def test_with_0_poses_the_report_shows_the_errors_of_the_first_action(trained, tmp_path, capsys):
    files = (trained.rig, trained.model, "--json", tmp_path / "errors.json")
    assert run("evaluate", *files, "--poses", 0, "--action", WAVE, "--strip", "swing") == 0
    report, table = json.loads((tmp_path / "errors.json").read_text()), capsys.readouterr().out
    assert report["poses"] == FRAMES and [a["name"] for a in report["actions"]] == [WAVE, "swing"]
    assert report["fdda"] == report["actions"][0]["fdda"] and report["fdda"]["mean"] < report["linear"]["mean"] / 2
    assert report["actions"][1]["poses"] == FRAMES and report["actions"][1]["linear"] != report["linear"]
    assert table.count(f"{WAVE}, {FRAMES} poses") == 1 and "swing" in table
    for options in ((), ("--action", WAVE, "--range-scale", 2)):
        assert run("evaluate", *files, "--poses", 0, *options) == 2
        assert "With --poses 0 only actions and strips are compared; give --action" in capsys.readouterr().err


def test_evaluation_of_an_action_needs_no_range_of_motion(trained):
    rig = trained.open()
    for bone in rig.armature_object.pose.bones:
        bone.lock_rotation = (True, True, True)
    evaluation = run_job(evaluate(rig, trained.model, EvaluationSettings(0, actions=(WAVE,), surface=False)))
    assert evaluation.held_out is evaluation.actions[0] and evaluation.held_out.name == WAVE
    with pytest.raises(RigError, match="nothing to evaluate: 0 poses and no action; give --poses or --action"):
        drain(evaluate(rig, trained.model, EvaluationSettings(0)))
