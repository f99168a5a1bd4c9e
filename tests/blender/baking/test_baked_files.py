# SPDX-License-Identifier: GPL-3.0-or-later
"""Baked files show the model's positions in a Blender without the add-on."""

import shutil
from pathlib import Path

import bpy
import numpy as np
import pytest

from fdda_addon.scene.blend_file import save_copy

from ..baked_files import (
    POSITION_TOLERANCE,
    WAVE_FRAMES,
    predicted_in_frames,
    predicted_wave,
    read_pc2,
    shown_without_add_on,
)
from ..conftest import ELBOW, ELBOW_RIG, evaluated_positions, run, train
from ..refusals import file_contents, save_elbow
from ..scene_state import fresh_elbow


@pytest.fixture(scope="module")
def wave_positions(elbow_files) -> np.ndarray:
    """Return the model's positions (F, V, 3) in all frames of the elbow's action."""
    return predicted_wave(elbow_files)


@pytest.fixture(scope="module")
def baked_folder(elbow_files, tmp_path_factory) -> Path:
    """Bake the elbow as a point cache, as a file with a cache, and as a file with shape keys; return the folder."""
    folder = tmp_path_factory.mktemp("baked")
    for options in (["walk.pc2"], ["cache.blend"], ["keys.blend", "--shape-keys"]):
        arguments = ["--action", "elbow_wave", *options[1:]]
        assert run("bake", elbow_files.rig, elbow_files.model, folder / options[0], *arguments) == 0
    return folder


class TestWrittenFiles:
    def test_a_point_cache_contains_the_model_s_positions(self, baked_folder, wave_positions):
        start, rate, positions = read_pc2(baked_folder / "walk.pc2")
        assert (start, rate) == (1, 1) and positions.shape == wave_positions.shape
        assert np.abs(positions - wave_positions).max() < 1e-6 < np.abs(np.diff(wave_positions, axis=0)).max()

    def test_baking_writes_no_other_files(self, baked_folder):
        assert sorted(file_contents(baked_folder)) == ["cache.blend", "cache.pc2", "keys.blend", "walk.pc2"]
        assert (baked_folder / "cache.pc2").read_bytes() == (baked_folder / "walk.pc2").read_bytes()

    @pytest.mark.parametrize("name", ["cache.blend", "keys.blend"])
    def test_a_baked_file_has_no_armature_modifier(self, baked_folder, name):
        bpy.ops.wm.open_mainfile(filepath=str(baked_folder / name))
        mesh_object = bpy.data.objects[ELBOW]
        assert [m.type for m in mesh_object.modifiers] == (["MESH_CACHE"] if name == "cache.blend" else [])
        assert len(bpy.data.objects) == 2 and mesh_object.parent == bpy.data.objects[ELBOW_RIG]
        assert bpy.context.scene.frame_current == 1


class TestWithoutTheAddOn:
    def test_baked_files_show_the_model_s_positions(self, baked_folder, wave_positions, tmp_path):
        """Check all frames, a subframe, and frames outside the range; also after the folder was moved."""
        moved = shutil.copytree(baked_folder, tmp_path / "moved")
        (moved / "walk.pc2").unlink()
        frames, subframe = list(map(float, WAVE_FRAMES)), 8.25
        times = [*frames, subframe, -5.0, 99.0]
        jobs = [(folder / name, times) for name in ("cache.blend", "keys.blend") for folder in (baked_folder, moved)]
        shown = shown_without_add_on(tmp_path, *jobs)
        for path, _ in jobs:
            positions = np.array([shown[path, time] for time in frames])
            assert np.abs(positions - wave_positions).max() < POSITION_TOLERANCE
            assert (
                np.abs(shown[path, subframe] - (0.75 * wave_positions[7] + 0.25 * wave_positions[8])).max()
                < POSITION_TOLERANCE
            )
            assert np.abs(shown[path, -5.0] - wave_positions[0]).max() < POSITION_TOLERANCE
            assert np.abs(shown[path, 99.0] - wave_positions[-1]).max() < POSITION_TOLERANCE

    def test_a_moved_file_plays_the_cache_in_its_own_folder(self, baked_folder, tmp_path):
        moved = shutil.copytree(baked_folder, tmp_path / "moved")
        data = bytearray((moved / "cache.pc2").read_bytes())
        data[32:] = np.ones((len(data) - 32) // 4, "<f4").tobytes()
        (moved / "cache.pc2").write_bytes(data)
        path = moved / "cache.blend"
        assert (shown_without_add_on(tmp_path, (path, [4.0]))[path, 4.0] == 1).all()

    def test_baking_into_another_folder_than_the_rig_s(self, elbow_files, wave_positions, tmp_path, monkeypatch):
        (tmp_path / "in").mkdir()
        (tmp_path / "out").mkdir()
        rig = shutil.copy(elbow_files.rig, tmp_path / "in" / "rig.blend")
        monkeypatch.chdir(tmp_path)
        assert run("bake", rig, elbow_files.model, "out/a.blend") == 0
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "out" / "a.blend"))
        assert bpy.data.objects[ELBOW].modifiers[0].filepath == "//a.pc2"
        assert np.abs(evaluated_positions(bpy.data.objects[ELBOW]) - wave_positions[0]).max() < POSITION_TOLERANCE

    def test_a_subdivision_after_the_baked_modifiers_is_kept(self, elbow_files, wave_positions, tmp_path):
        def subdivide(rig):
            modifier = rig.mesh_object.modifiers.new("Finer", "SUBSURF")
            modifier.levels, modifier.use_pin_to_last = 1, True

        rig = save_elbow(tmp_path / "rig.blend", subdivide)
        outs = [tmp_path / "cache.blend", tmp_path / "keys.blend"]
        for out, options in zip(outs, ([], ["--shape-keys"]), strict=True):
            assert run("bake", rig, elbow_files.model, out, "--action", "elbow_wave", *options) == 0
        bpy.ops.wm.open_mainfile(filepath=str(outs[0]))
        assert [m.type for m in bpy.data.objects[ELBOW].modifiers] == ["MESH_CACHE", "SUBSURF"]
        shown = shown_without_add_on(tmp_path, *((out, [10.0]) for out in outs))
        mesh_object = fresh_elbow().mesh_object
        mesh_object.modifiers.clear()
        mesh_object.data.attributes["position"].data.foreach_set("vector", wave_positions[9].reshape(-1))
        mesh_object.modifiers.new("Finer", "SUBSURF").levels = 1
        expected = evaluated_positions(mesh_object)
        assert len(expected) > 3 * len(wave_positions[9])
        for out in outs:
            assert np.abs(shown[out, 10.0] - expected).max() < POSITION_TOLERANCE

    def test_shape_keys_and_an_armature_parent_do_not_change_a_bake(self, elbow_files, wave_positions, tmp_path):
        """The mesh keeps its shape keys for another object that uses it."""

        def add_keys_and_parent(rig):
            mesh_object = rig.mesh_object
            twin = bpy.data.objects.new("twin", mesh_object.data)
            bpy.context.scene.collection.objects.link(twin)
            mesh_object.shape_key_add(name="Basis")
            fat = mesh_object.shape_key_add(name="Fat")
            fat.data.foreach_set("co", np.full(3 * len(mesh_object.data.vertices), 5, np.float32))
            fat.value = 1.0
            mesh_object.parent_type = "ARMATURE"
            mesh_object.show_only_shape_key, mesh_object.active_shape_key_index = True, 0

        rig = save_elbow(tmp_path / "rig.blend", add_keys_and_parent)
        outs = [tmp_path / "cache.blend", tmp_path / "keys.blend"]
        for out, options in zip(outs, ([], ["--shape-keys"]), strict=True):
            assert run("bake", rig, elbow_files.model, out, "--action", "elbow_wave", *options) == 0
        shown = shown_without_add_on(tmp_path, *((out, [1.0, 10.0]) for out in outs))
        for out in outs:
            assert np.abs(shown[out, 10.0] - wave_positions[9]).max() < POSITION_TOLERANCE
            assert np.abs(shown[out, 1.0] - wave_positions[0]).max() < POSITION_TOLERANCE
        bpy.ops.wm.open_mainfile(filepath=str(outs[1]))
        assert [key.name for key in bpy.data.objects["twin"].data.shape_keys.key_blocks] == ["Basis", "Fat"]
        keys = bpy.data.objects[ELBOW].data.shape_keys.key_blocks
        assert [key.name for key in keys] == ["Basis", *(f"Frame {frame}" for frame in WAVE_FRAMES)]


class TestLinkedCharacters:
    @pytest.fixture
    def shot(self, elbow_files, tmp_path) -> Path:
        """Return a function that saves a file with a linked elbow, or with a library override of it."""

        def make_shot(is_overridden: bool) -> Path:
            bpy.ops.wm.read_factory_settings(use_empty=True)
            path = tmp_path / "shot.blend"
            save_copy(path)
            bpy.ops.wm.open_mainfile(filepath=str(path))
            with bpy.data.libraries.load(str(elbow_files.rig), link=True) as (_, into):
                into.objects = [ELBOW, ELBOW_RIG]
            for linked in list(into.objects):
                bpy.context.scene.collection.objects.link(linked)
            if is_overridden:
                for linked in list(into.objects):
                    linked.override_create(remap_local_usages=True)
            save_copy(path)
            return path

        return make_shot

    def test_a_linked_character_is_baked_into_a_point_cache_only(
        self, shot, elbow_files, wave_positions, tmp_path, capfd
    ):
        path = shot(is_overridden=False)
        assert run("bake", path, elbow_files.model, tmp_path / "a.pc2", "--frames", 1, 30) == 0
        assert np.abs(read_pc2(tmp_path / "a.pc2")[2] - wave_positions).max() < 1e-6
        assert run("bake", path, elbow_files.model, tmp_path / "a.blend") == 1
        assert "so its modifiers cannot be replaced here; bake it in that file" in capfd.readouterr().err

    @pytest.mark.parametrize("options", [[], ["--shape-keys"]], ids=["cache", "keys"])
    def test_a_library_override_is_baked(self, shot, elbow_files, wave_positions, tmp_path, options):
        path = shot(is_overridden=True)
        out = tmp_path / "a.blend"
        assert run("bake", path, elbow_files.model, out, "--frames", 1, 30, *options) == 0
        shown = shown_without_add_on(tmp_path, (out, [9.0]))
        assert np.abs(shown[out, 9.0] - wave_positions[8]).max() < POSITION_TOLERANCE


def test_a_bake_includes_animated_controls(tmp_path):
    """An animated shape key is an input of the model. The bake includes its effect, but not the shape key."""

    def add_key(rig):
        rig.mesh_object.shape_key_add(name="Basis")
        key, keys = rig.mesh_object.shape_key_add(name="Fat"), rig.mesh_object.data.shape_keys
        for vertex in key.data:
            vertex.co *= 1.3
        for frame, value in ((1, 0.0), (20, 1.0)):
            key.value = value
            keys.keyframe_insert('key_blocks["Fat"].value', frame=frame)

    rig, model, out = save_elbow(tmp_path / "rig.blend", add_key), tmp_path / "m.onnx", tmp_path / "a.blend"
    assert run("record", rig, tmp_path / "r", "--poses", 40, "--control", "Fat") == 0
    train(tmp_path / "r", model, "--epochs", 4)
    assert run("bake", rig, model, out, "--action", "elbow_wave", "--shape-keys") == 0
    assert run("bake", rig, model, tmp_path / "a.pc2", "--action", "elbow_wave") == 0
    bpy.ops.wm.open_mainfile(filepath=str(rig))
    expected = predicted_in_frames(WAVE_FRAMES, model)
    keys = bpy.data.objects[ELBOW].data.shape_keys
    keys.animation_data_clear()
    keys.key_blocks["Fat"].value = 0.0
    assert np.abs(predicted_in_frames([20], model)[0] - expected[19]).max() > 0.01, "the shape key moves vertices"
    assert np.abs(read_pc2(tmp_path / "a.pc2")[2] - expected).max() < 1e-6
    shown = shown_without_add_on(tmp_path, (out, [20.0]))
    assert np.abs(shown[out, 20.0] - expected[19]).max() < POSITION_TOLERANCE
