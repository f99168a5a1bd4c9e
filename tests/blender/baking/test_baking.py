# SPDX-License-Identifier: GPL-3.0-or-later
"""Baking writes the model's positions, and restores the scene."""

import bpy
import numpy as np
import pytest

from fdda_addon.baking.run import MAX_BATCH_FRAMES, BakeSettings, bake
from fdda_addon.scene.scene_rig import find_rig

from ..baked_files import POSITION_TOLERANCE, predicted_in_frames, predicted_wave, read_pc2
from ..conftest import ELBOW, ELBOW_RIG, evaluated_positions, run
from ..refusals import file_contents, save_elbow
from ..scene_state import assert_same_state, drain, fresh_elbow, scene_state


@pytest.fixture(scope="module")
def wave_positions(elbow_files) -> np.ndarray:
    """Return the model's positions (F, V, 3) in all frames of the elbow's action."""
    return predicted_wave(elbow_files)


def test_baking_more_frames_than_a_batch(elbow_files, tmp_path):
    frames = range(-9, 3 * MAX_BATCH_FRAMES)
    out = tmp_path / "long.pc2"
    assert run("bake", elbow_files.rig, elbow_files.model, out, "--frames", frames[0], frames[-1]) == 0
    start, _, positions = read_pc2(out)
    bpy.ops.wm.open_mainfile(filepath=str(elbow_files.rig))
    assert start == -9 and len(positions) == len(frames)
    assert np.abs(positions - predicted_in_frames(frames, elbow_files.model)).max() < 1e-6


def test_bake_prints_its_files_and_frames(elbow_files, tmp_path, capfd):
    out = tmp_path / "a.blend"
    assert run("bake", elbow_files.rig, elbow_files.model, out, "--action", "elbow_wave", "--frames", 3, 7) == 0
    captured = capfd.readouterr()
    assert captured.out.splitlines() == [
        f"{tmp_path / 'a.pc2'}: the positions, to be kept beside a.blend",
        f"{out}: 5 frames of elbow_wave (3 to 7)",
    ]
    assert captured.err.splitlines()[-1].startswith("frames: 5 of 5, ")
    assert run("bake", elbow_files.rig, elbow_files.model, tmp_path / "b.pc2") == 0
    assert capfd.readouterr().out == f"{tmp_path / 'b.pc2'}: 30 frames of the scene (1 to 30)\n"
    assert run("bake", elbow_files.rig, elbow_files.model, tmp_path / "c.pc2", "--frames", 4, 4) == 0
    assert capfd.readouterr().out == f"{tmp_path / 'c.pc2'}: 1 frame of the scene (4 to 4)\n"


def add_other_animation(rig) -> None:
    """Give the armature another active action that moves it, and an NLA strip with the action `elbow_wave`."""
    armature_object = rig.armature_object
    animation = armature_object.animation_data
    animation.action = bpy.data.actions.new("other")
    for frame, angle in ((5, 0.2), (12, 1.4)):
        armature_object.pose.bones["lower"].rotation_euler[0] = angle
        armature_object.pose.bones["lower"].keyframe_insert("rotation_euler", index=0, frame=frame)
        armature_object.location[2] = angle
        armature_object.keyframe_insert("location", frame=frame)
    track = animation.nla_tracks.new()
    track.strips.new("wave", 1, bpy.data.actions["elbow_wave"])
    track.strips[0].use_auto_blend = False


def test_without_an_action_the_animation_of_the_scene_is_baked(elbow_files, wave_positions, tmp_path):
    """Bake the active action with the NLA, then the action `elbow_wave` alone."""
    rig = save_elbow(tmp_path / "rig.blend", add_other_animation)
    assert run("bake", rig, elbow_files.model, tmp_path / "scene.pc2", "--frames", 5, 12) == 0
    assert run("bake", rig, elbow_files.model, tmp_path / "action.blend", "--action", "elbow_wave") == 0
    bpy.ops.wm.open_mainfile(filepath=str(rig))
    expected = predicted_in_frames(range(5, 13), elbow_files.model)
    _, _, scene_positions = read_pc2(tmp_path / "scene.pc2")
    assert np.abs(scene_positions - expected).max() < 1e-6
    assert np.abs(scene_positions - wave_positions[4:12]).max() > 0.01
    assert np.abs(read_pc2(tmp_path / "action.pc2")[2] - wave_positions).max() < 1e-6
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "action.blend"))
    animation = bpy.data.objects[ELBOW_RIG].animation_data
    assert animation.action.name == "elbow_wave" and not animation.use_nla


@pytest.mark.parametrize(("old", "new"), [(100, 200), (100, 50), (90, 200)])
def test_a_bake_of_stretched_time_shows_the_model_in_every_frame(elbow_files, tmp_path, old, new):
    def stretch(_rig) -> None:
        render = bpy.context.scene.render
        render.frame_map_old, render.frame_map_new = old, new

    rig = save_elbow(tmp_path / "rig.blend", stretch)
    for out, options in (("cache.blend", []), ("keys.blend", ["--shape-keys"])):
        arguments = ["--action", "elbow_wave", *options]
        assert run("bake", rig, elbow_files.model, tmp_path / out, *arguments) == 0
    frames = range(-3, 5 + 30 * new // old)
    bpy.ops.wm.open_mainfile(filepath=str(rig))
    expected = predicted_in_frames(frames, elbow_files.model)
    assert np.ptp(expected, axis=0).max() > 0.1
    for out in ("cache.blend", "keys.blend"):
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / out))
        for frame, positions in zip(frames, expected, strict=True):
            bpy.context.scene.frame_set(frame)
            assert np.abs(evaluated_positions(bpy.data.objects[ELBOW]) - positions).max() < POSITION_TOLERANCE


def test_a_baked_bound_file_is_not_bound(elbow_files, wave_positions, tmp_path):
    """Baking removes the binding, so the add-on ignores the file."""
    assert run("bake", elbow_files.bound, elbow_files.model, tmp_path / "a.blend") == 0
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    mesh_object = bpy.data.objects[ELBOW]
    assert not mesh_object.fdda.is_bound and [m.type for m in mesh_object.modifiers] == ["MESH_CACHE"]
    assert len(bpy.data.objects) == 2
    bpy.context.scene.frame_set(17)
    assert np.abs(evaluated_positions(mesh_object) - wave_positions[16]).max() < POSITION_TOLERANCE


class TestSceneRestoration:
    @pytest.mark.parametrize("out", ["a.pc2", "a.blend", "keys.blend"])
    @pytest.mark.parametrize("action", ["elbow_wave", ""], ids=["action", "scene"])
    def test_baking_restores_the_scene(self, unusual_rig, elbow_files, tmp_path, out, action):
        bpy.data.objects[ELBOW].use_fake_user = True
        before = scene_state(unusual_rig)
        drain(
            bake(unusual_rig, elbow_files.model, tmp_path / out, BakeSettings(action, (1, 12), out.startswith("keys")))
        )
        assert_same_state(before, scene_state(find_rig()))
        assert bpy.data.objects[ELBOW].use_fake_user
        if out == "a.blend":
            bpy.ops.wm.open_mainfile(filepath=str(tmp_path / out))
            assert sorted(o.name for o in bpy.data.objects) == [ELBOW, ELBOW_RIG]

    def test_a_canceled_bake_leaves_no_files(self, unusual_rig, elbow_files, tmp_path):
        before = scene_state(unusual_rig)
        for index, name in enumerate(("a.pc2", "a.blend", "keys.blend")):
            settings = BakeSettings("elbow_wave", shape_keys=name.startswith("keys"))
            drain(bake(unusual_rig, elbow_files.model, tmp_path / name, settings), stop_after=3 + index)
            assert_same_state(before, scene_state(unusual_rig))
        assert file_contents(tmp_path) == {}

    def test_objects_hidden_in_some_frames_are_baked_in_all_frames(self, elbow_files, wave_positions, tmp_path):
        rig = fresh_elbow()
        rig.mesh_object.parent = None
        for scene_object in (rig.mesh_object, rig.armature_object):
            for frame, hidden in ((1, False), (4, True)):
                scene_object.hide_viewport = hidden
                scene_object.keyframe_insert("hide_viewport", frame=frame)
        bpy.context.scene.frame_set(2)
        before = scene_state(rig)
        drain(bake(rig, elbow_files.model, tmp_path / "a.pc2", BakeSettings(frames=(3, 30))))
        assert_same_state(before, scene_state(rig))
        assert np.abs(read_pc2(tmp_path / "a.pc2")[2] - wave_positions[2:]).max() < 1e-6
        bpy.context.scene.frame_set(5)
        assert rig.mesh_object.hide_viewport and rig.armature_object.hide_viewport
