# SPDX-License-Identifier: GPL-3.0-or-later
"""Poses from animation: actions and strips, mirrored, of all datablocks of a rig; recorded, resumed, evaluated."""

import json

import bpy
import numpy as np
import pytest

from fdda_addon.core.errors import RecordingError, RigError
from fdda_addon.core.recording.reader import Recording, read_recording
from fdda_addon.core.skinning import LinearSkinning
from fdda_addon.evaluation.run import EvaluationSettings, evaluate
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.recording.run import record
from fdda_addon.scene.scene_rig import SceneRig

from .conftest import run, train
from .figure import ARM_REACH, FRAMES, SMILE, WAVE, add_smile, add_wave, build_figure, edit_bones, key_channel
from .scene_state import assert_same_state, drain, scene_state

HAS_SLOTS = bpy.app.version >= (4, 4, 0)
needs_slots = pytest.mark.skipif(not HAS_SLOTS, reason="actions have slots from Blender 4.4 on")


@pytest.fixture
def figure() -> SceneRig:
    rig = build_figure()
    add_wave(rig)
    return rig


def recorded(rig: SceneRig, path, **settings) -> Recording:
    """A recording without random poses unless said otherwise."""
    drain(record(rig, path, RecordingSettings(**{"poses": 0, "influence_poses": 2, **settings})))
    return read_recording(path)


def positions(recording: Recording) -> np.ndarray:
    """(N, V, 3) what Blender evaluated."""
    matrices = np.array(recording.pose_matrices)
    skinning = LinearSkinning(recording.rig, recording.partitions)
    return skinning.complex_positions(matrices, np.array(recording.residuals))


def evaluated(rig: SceneRig) -> np.ndarray:
    """(V, 3) what Blender shows now."""
    mesh_object = rig.mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get())
    return np.array([vertex.co[:] for vertex in mesh_object.data.vertices], np.float32)


def played(rig: SceneRig, frames) -> np.ndarray:
    """(F, V, 3) what the rig shows when its own animation plays."""
    found = []
    for frame in frames:
        bpy.context.scene.frame_set(frame)
        found.append(evaluated(rig))
    return np.array(found)


def other_side(rig: SceneRig, points: np.ndarray) -> np.ndarray:
    """Positions mirrored: each vertex takes the place of the one on the other side."""
    rest = np.array([vertex.co[:] for vertex in rig.mesh_object.data.vertices])
    apart = np.linalg.norm(rest[:, None] * [-1, 1, 1] - rest[None], axis=-1)
    assert apart.min(axis=1).max() < 1e-6
    return points[:, apart.argmin(axis=1)] * [-1, 1, 1]


def strip_of(rig: SceneRig, action: bpy.types.Action, start: int = 40, name: str = "swing") -> bpy.types.NlaStrip:
    """Put an action into the NLA, with one below it that turns the spine."""
    animation = rig.armature_object.animation_data
    animation.action = lean = bpy.data.actions.new("lean")
    key_channel(rig.armature_object.pose.bones["spine"], 1, "rotation_euler", (0, 0, 0.3))
    below = animation.nla_tracks.new()
    below.strips.new("lean", 1, lean).frame_end = 200
    above = animation.nla_tracks.new()
    above.name = "above"
    strip = above.strips.new("swing", start, action)
    strip.name, strip.blend_type = name, "COMBINE"
    animation.action = None
    return strip


def test_the_frames_of_a_strip_are_those_of_the_whole_nla(figure, tmp_path):
    strip_of(figure, bpy.data.actions[WAVE])
    shown = played(figure, range(40, 40 + FRAMES))
    other = bpy.data.actions.new("other")
    figure.armature_object.animation_data.action = other
    key_channel(figure.armature_object.pose.bones["arm.R"], 1, "rotation_quaternion", (0.5, 0.5, 0.5, 0.5))
    before = scene_state(figure)
    recording = recorded(figure, tmp_path / "recording", strips=("swing",))
    assert_same_state(before, scene_state(figure))
    (source,) = recording.info.sampling.sources
    assert (source.kind, source.poses, source.name, source.frames) == ("strip", FRAMES, "swing", (40, 1))
    np.testing.assert_allclose(positions(recording), shown, atol=1e-5)
    alone = recorded(figure, tmp_path / "alone", actions=(WAVE,))
    assert np.abs(positions(alone) - shown).max() > 0.05, "the track below plays along"


def test_mirrored_frames_are_the_mirror_images(figure, tmp_path):
    shown = played(figure, range(1, FRAMES + 1))
    before = scene_state(figure)
    recording = recorded(figure, tmp_path / "recording", actions=(WAVE,), mirror=True)
    assert_same_state(before, scene_state(figure))
    assert [(s.kind, s.poses, s.name, s.frames) for s in recording.info.sampling.sources] == [
        ("action", FRAMES, WAVE, (1, 1)),
        ("mirrored", FRAMES, WAVE, (1, 1)),
    ]
    found = positions(recording)
    np.testing.assert_allclose(found[:FRAMES], shown, atol=1e-5)
    np.testing.assert_allclose(found[FRAMES:], other_side(figure, shown), atol=1e-5)
    assert np.abs(found[FRAMES:] - found[:FRAMES]).max() > 0.1


def test_mirrored_strips(figure, tmp_path):
    strip_of(figure, bpy.data.actions[WAVE])
    shown = played(figure, range(40, 40 + FRAMES))
    recording = recorded(figure, tmp_path / "recording", strips=("swing",), mirror=True)
    np.testing.assert_allclose(positions(recording)[FRAMES:], other_side(figure, shown), atol=1e-5)


def test_numbers_with_a_left_and_a_right_are_exchanged(figure, tmp_path):
    """A fist that is keyed, one that is not; what they drive follows."""
    figure.armature_object.pose.bones["arm.R"]["fist"] = 0.25
    names = [f'armature_object/pose.bones["arm.{side}"]["fist"]=0:1' for side in "LR"]
    before = scene_state(figure)
    recording = recorded(figure, tmp_path / "recording", actions=(WAVE,), mirror=True, controls=tuple(names))
    assert_same_state(before, scene_state(figure))
    controls = np.array(recording.controls)
    assert np.ptp(controls[:FRAMES, 0]) > 0.9 and (controls[:FRAMES, 1] == 0.25).all()
    np.testing.assert_array_equal(controls[FRAMES:], controls[:FRAMES, ::-1])


def test_rigs_that_are_not_the_same_on_both_sides_are_refused(figure, tmp_path):
    def refusal() -> str:
        with pytest.raises(RigError) as error:
            recorded(figure, tmp_path / "recording", actions=(WAVE,), mirror=True)
        assert not (tmp_path / "recording").exists()
        return str(error.value)

    bones = figure.armature_object.pose.bones
    bones["arm.R"].rotation_mode = "XYZ"
    assert "the bones 'arm.L' and 'arm.R' differ in rotation mode; symmetrize the armature" in refusal()
    bones["arm.R"].rotation_mode = "QUATERNION"
    edit_bones(figure, lambda edited: setattr(edited["arm.R"], "roll", edited["arm.R"].roll + 0.2))
    assert "the bones 'arm.L' and 'arm.R' differ in roll or direction, by 11.5°" in refusal()
    edit_bones(figure, lambda edited: edited["arm.R"].align_roll((0, -1, 0)))
    edit_bones(figure, lambda edited: setattr(edited["arm.R"], "tail", (-ARM_REACH - 0.01, 0, 0.9)))
    assert "the bones 'arm.L' and 'arm.R' differ by 10.0 mm" in refusal()
    edit_bones(figure, lambda edited: edited.remove(edited["arm.R"]))
    assert "there is no bone 'arm.R' for 'arm.L'; add it, or leave mirroring out." in refusal()
    edit_bones(figure, lambda edited: setattr(edited["spine"], "head", (0.1, 0, 0)))
    assert "the bone 'spine' differs from its mirror image by 200.0 mm; bring it into the middle" in refusal()


def test_mirroring_needs_animation(figure, tmp_path):
    with pytest.raises(RecordingError, match="nothing to mirror: no action and no strip; give --action or --strip"):
        recorded(figure, tmp_path / "recording", poses=3, mirror=True)


def test_strips_that_are_missing_or_muted_are_refused(figure, tmp_path):
    strip = strip_of(figure, bpy.data.actions[WAVE])
    with pytest.raises(RigError, match=r"NLA of 'figure_rig' has no strip 'jump'; its strips: 'lean', 'swing'\."):
        recorded(figure, tmp_path / "recording", strips=("jump",))
    strip.mute = True
    with pytest.raises(RigError, match="'swing' of 'figure_rig' is muted and shows nothing; unmute it and its track"):
        recorded(figure, tmp_path / "recording", strips=("swing",))


@needs_slots
def test_an_action_moves_the_shape_keys_that_it_has_curves_for(figure, tmp_path):
    wave, keys = bpy.data.actions[WAVE], figure.mesh_object.data.shape_keys
    add_smile(figure, wave)
    keys.animation_data.action = own = bpy.data.actions.new("own")
    keys.key_blocks["Smile"].value = 0.9
    keys.keyframe_insert(SMILE, frame=1)
    bpy.context.view_layer.update()
    keys.key_blocks["Smile"].value = 0.3
    slot = keys.animation_data.action_slot.identifier
    before = scene_state(figure)
    for controls in ((), ("Smile",)):
        recording = recorded(figure, tmp_path / f"recording{len(controls)}", actions=(WAVE,), controls=controls)
        found = positions(recording)
        still = recorded(figure, tmp_path / f"still{len(controls)}", actions=("own",))
        assert (keys.animation_data.action, keys.animation_data.action_slot.identifier) == (own, slot)
        assert keys.key_blocks["Smile"].value == pytest.approx(0.3)
        middle = FRAMES // 2 - 1
        raised = np.linalg.norm(found - positions(still)[0], axis=-1)
        assert raised[middle].max() > 0.02
        if controls:
            values = np.array(recording.controls)[:, 0]
            assert values[0] == 0 and values[middle] == pytest.approx(0.8) and values[-1] == 0
    assert_same_state({**before, "positions": ()}, {**scene_state(figure), "positions": ()})


@needs_slots
def test_actions_made_for_another_character_and_slots_of_others(figure, tmp_path):
    """The slot that is named like the datablock counts; a figure of another name takes the one that moves bones."""
    wave = bpy.data.actions[WAVE]
    expected = positions(recorded(figure, tmp_path / "own", actions=(WAVE,)))
    figure.armature_object.name = "someone"
    wave.slots.new(id_type="OBJECT", name="table")
    np.testing.assert_array_equal(positions(recorded(figure, tmp_path / "other", actions=(WAVE,))), expected)


def test_what_random_poses_set_does_not_show_in_actions(figure, tmp_path):
    """So that a recording that is resumed in an action has the same bytes."""
    name = 'armature_object/pose.bones["arm.R"]["fist"]'
    figure.armature_object.pose.bones["arm.R"]["fist"] = 0.5
    recording = recorded(figure, tmp_path / "recording", poses=5, actions=(WAVE,), controls=(f"{name}=0:1",))
    values = np.array(recording.controls)[:, [c.name for c in recording.rig.controls].index(name)]
    assert np.ptp(values[:5]) > 0 and (values[5:] == 0.5).all()


@pytest.mark.parametrize("stop", [8, 30, 55])
def test_resumed_recordings_have_the_same_bytes(figure, tmp_path, stop):
    """Stopped among the random poses, in the action, in its mirror image."""
    strip_of(figure, bpy.data.actions[WAVE])
    name = 'armature_object/pose.bones["arm.R"]["fist"]=0:1'
    settings = {"poses": 10, "actions": (WAVE,), "strips": ("swing",), "mirror": True, "influence_poses": 1}
    settings = RecordingSettings(**settings, controls=(name,))
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    drain(record(figure, whole, settings))
    steps = record(figure, parts, settings)
    for step in steps:
        if step.stage == "poses" and step.done == stop:
            steps.close()
    index = json.loads((parts / "recording.json").read_text())
    assert stop <= index["complete"] < index["poses"] == 10 + 4 * FRAMES
    drain(record(figure, parts, RecordingSettings(**{**settings.__dict__, "resume": True})))
    for file in whole.iterdir():
        assert file.read_bytes() == (parts / file.name).read_bytes(), file.name


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A figure, and a model of it that was trained on its action alone."""
    import fdda_addon

    folder = tmp_path_factory.mktemp("figure")
    fdda_addon.register()
    rig = build_figure()
    add_wave(rig)
    strip_of(rig, bpy.data.actions[WAVE])
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "figure.blend"))
    options = ("--poses", 0, "--action", WAVE, "--mirror")
    assert run("record", folder / "figure.blend", folder / "recording", *options) == 0
    train(folder / "recording", folder / "figure.onnx", "--epochs", 30)
    return folder


def test_the_first_action_stands_in_place_of_held_out_poses(trained, tmp_path, capsys):
    files = (trained / "figure.blend", trained / "figure.onnx", "--json", tmp_path / "errors.json")
    assert run("evaluate", *files, "--poses", 0, "--action", WAVE, "--strip", "swing") == 0
    report, table = json.loads((tmp_path / "errors.json").read_text()), capsys.readouterr().out
    assert report["poses"] == FRAMES and [a["name"] for a in report["actions"]] == [WAVE, "swing"]
    assert report["fdda"] == report["actions"][0]["fdda"] and report["fdda"]["mean"] < report["linear"]["mean"] / 2
    assert report["actions"][1]["poses"] == FRAMES and report["actions"][1]["linear"] != report["linear"]
    assert table.count(f"{WAVE}, {FRAMES} poses") == 1 and "swing" in table
    for wrong in ((), ("--action", WAVE, "--range-scale", 2)):
        assert run("evaluate", *files, "--poses", 0, *wrong) == 2
        assert "With --poses 0 only actions and strips are compared; give --action" in capsys.readouterr().err


def test_evaluation_without_poses_needs_no_range_of_motion(trained):
    bpy.ops.wm.open_mainfile(filepath=str(trained / "figure.blend"))
    rig = SceneRig(bpy.data.objects["body"], bpy.data.objects["figure_rig"])
    for bone in rig.armature_object.pose.bones:
        bone.lock_rotation = (True, True, True)
    *_, found = evaluate(rig, trained / "figure.onnx", EvaluationSettings(0, actions=(WAVE,), surface=False))
    assert found.held_out is found.actions[0] and found.held_out.name == WAVE
    with pytest.raises(RigError, match="nothing to evaluate: 0 poses and no action; give --poses or --action"):
        drain(evaluate(rig, trained / "figure.onnx", EvaluationSettings(0)))


def test_sidebar_records_mirrored_frames(figure, tmp_path):
    bpy.context.view_layer.objects.active = figure.mesh_object
    settings = figure.mesh_object.fdda.settings
    settings.poses, settings.mirror = 3, True
    settings.recording = str(tmp_path / "without")
    assert bpy.ops.fdda.record() == {"FINISHED"}, "nothing is ticked, so there is nothing to mirror"
    bpy.data.actions[WAVE].fdda.record = True
    settings.recording = str(tmp_path / "with")
    assert bpy.ops.fdda.record() == {"FINISHED"}
    kinds = [s.kind for s in read_recording(tmp_path / "with").info.sampling.sources]
    assert kinds == ["random", "action", "mirrored"]
