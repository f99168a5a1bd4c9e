# SPDX-License-Identifier: GPL-3.0-or-later
"""Baking: what is written is what the model says, and the scene is as before."""

import bpy
import numpy as np
import pytest

from fdda_addon.baking.run import MAX_BATCH_FRAMES, BakeSettings, bake
from fdda_addon.scene.scene_rig import find_rig

from .baked_files import POSITION_TOLERANCE, predicted_in_frames, predicted_wave, read_pc2
from .conftest import ELBOW, ELBOW_RIG, evaluated, run
from .refusals import file_contents, save_elbow
from .scene_state import assert_same_state, drain, fresh_elbow, scene_state, set_unusual_state


@pytest.fixture(scope="module")
def wave(elbow) -> np.ndarray:
    return predicted_wave(elbow)


def test_more_frames_than_a_batch_take(elbow, tmp_path):
    frames = range(-9, 3 * MAX_BATCH_FRAMES)
    out = tmp_path / "long.pc2"
    assert run("bake", elbow.rig, elbow.model, out, "--frames", frames[0], frames[-1]) == 0
    start, _, positions = read_pc2(out)
    bpy.ops.wm.open_mainfile(filepath=str(elbow.rig))
    assert start == -9 and len(positions) == len(frames)
    assert np.abs(positions - predicted_in_frames(frames, elbow.model)).max() < 1e-6


def test_what_is_printed(elbow, tmp_path, capfd):
    out = tmp_path / "a.blend"
    assert run("bake", elbow.rig, elbow.model, out, "--action", "elbow_wave", "--frames", 3, 7) == 0
    captured = capfd.readouterr()
    assert captured.out.splitlines() == [
        f"{tmp_path / 'a.pc2'}: the positions, to be kept beside a.blend",
        f"{out}: 5 frames of elbow_wave (3 to 7)",
    ]
    assert captured.err.splitlines()[-1].startswith("frames: 5 of 5, ")
    assert run("bake", elbow.rig, elbow.model, tmp_path / "b.pc2") == 0
    assert capfd.readouterr().out == f"{tmp_path / 'b.pc2'}: 30 frames of the scene (1 to 30)\n"


def put_aside(rig) -> None:
    """Another action drives the armature, moves it as a whole, and bends it below the one that is baked."""
    armature_object = rig.armature_object
    animation = armature_object.animation_data
    other = bpy.data.actions.new("other")
    animation.action = other
    for frame, angle in ((5, 0.2), (12, 1.4)):
        armature_object.pose.bones["lower"].rotation_euler[0] = angle
        armature_object.pose.bones["lower"].keyframe_insert("rotation_euler", index=0, frame=frame)
        armature_object.location[2] = angle
        armature_object.keyframe_insert("location", frame=frame)
    track = animation.nla_tracks.new()
    track.strips.new("wave", 1, bpy.data.actions["elbow_wave"])
    track.strips[0].use_auto_blend = False


def test_the_scene_as_it_is_animated(elbow, wave, tmp_path):
    """NLA, and an action that is not the one that could be named; then that one alone."""
    rig = save_elbow(tmp_path / "rig.blend", put_aside)
    assert run("bake", rig, elbow.model, tmp_path / "scene.pc2", "--frames", 5, 12) == 0
    assert run("bake", rig, elbow.model, tmp_path / "action.blend", "--action", "elbow_wave") == 0
    bpy.ops.wm.open_mainfile(filepath=str(rig))
    expected = predicted_in_frames(range(5, 13), elbow.model)
    _, _, scene = read_pc2(tmp_path / "scene.pc2")
    assert np.abs(scene - expected).max() < 1e-6 and np.abs(scene - wave[4:12]).max() > 0.01
    assert np.abs(read_pc2(tmp_path / "action.pc2")[2] - wave).max() < 1e-6
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "action.blend"))
    animation = bpy.data.objects[ELBOW_RIG].animation_data
    assert animation.action.name == "elbow_wave" and not animation.use_nla


def test_a_bound_file(elbow, wave, tmp_path):
    """Nothing of the binding is left, so that the add-on has nothing to do where it is."""
    assert run("bake", elbow.bound, elbow.model, tmp_path / "a.blend") == 0
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    mesh_object = bpy.data.objects[ELBOW]
    assert not mesh_object.fdda.is_bound and [m.type for m in mesh_object.modifiers] == ["MESH_CACHE"]
    assert len(bpy.data.objects) == 2
    bpy.context.scene.frame_set(17)
    assert np.abs(evaluated(mesh_object) - wave[16]).max() < POSITION_TOLERANCE


class TestBorrowed:
    @pytest.fixture
    def disarranged(self):
        rig = fresh_elbow()
        set_unusual_state(rig)
        return rig

    @pytest.mark.parametrize("out", ["a.pc2", "a.blend", "keys.blend"])
    @pytest.mark.parametrize("action", ["elbow_wave", ""], ids=["action", "scene"])
    def test_the_scene_is_as_before(self, disarranged, elbow, tmp_path, out, action):
        bpy.data.objects[ELBOW].use_fake_user = True
        before = scene_state(disarranged)
        drain(bake(disarranged, elbow.model, tmp_path / out, BakeSettings(action, (1, 12), out.startswith("keys"))))
        assert_same_state(before, scene_state(find_rig()))
        assert bpy.data.objects[ELBOW].use_fake_user
        if out == "a.blend":
            bpy.ops.wm.open_mainfile(filepath=str(tmp_path / out))
            assert sorted(o.name for o in bpy.data.objects) == [ELBOW, ELBOW_RIG]

    def test_a_bake_that_is_closed_leaves_nothing(self, disarranged, elbow, tmp_path):
        before = scene_state(disarranged)
        for number, name in enumerate(("a.pc2", "a.blend", "keys.blend")):
            settings = BakeSettings("elbow_wave", shape_keys=name.startswith("keys"))
            drain(bake(disarranged, elbow.model, tmp_path / name, settings), stop_after=3 + number)
            assert_same_state(before, scene_state(disarranged))
        assert file_contents(tmp_path) == {}

    def test_what_hides_in_some_frames_is_baked_in_all(self, elbow, wave, tmp_path):
        rig = fresh_elbow()
        rig.mesh_object.parent = None
        for scene_object in (rig.mesh_object, rig.armature_object):
            for frame, hidden in ((1, False), (4, True)):
                scene_object.hide_viewport = hidden
                scene_object.keyframe_insert("hide_viewport", frame=frame)
        bpy.context.scene.frame_set(2)
        before = scene_state(rig)
        drain(bake(rig, elbow.model, tmp_path / "a.pc2", BakeSettings(frames=(3, 30))))
        assert_same_state(before, scene_state(rig))
        assert np.abs(read_pc2(tmp_path / "a.pc2")[2] - wave[2:]).max() < 1e-6
        bpy.context.scene.frame_set(5)
        assert rig.mesh_object.hide_viewport and rig.armature_object.hide_viewport
