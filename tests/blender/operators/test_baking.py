# SPDX-License-Identifier: GPL-3.0-or-later
"""The operator that bakes the bound model, with its strength and mode."""

import bpy
import numpy as np
import pytest

from fdda_addon.scene.scene_rig import find_rig

from ..baked_files import POSITION_TOLERANCE, predicted_wave, read_pc2, shown_without_add_on
from ..conftest import ELBOW, assert_plays, evaluated_positions, pose
from ..refusals import file_contents, refused
from ..scene_state import assert_same_state, scene_state


@pytest.fixture(scope="module")
def wave(elbow_files) -> np.ndarray:
    return predicted_wave(elbow_files)


class TestOperator:
    @pytest.mark.parametrize("action", ["elbow_wave", ""])
    def test_the_bound_model_is_baked_and_stays_bound(self, active, elbow_files, wave, tmp_path, action):
        before = scene_state(find_rig())
        out = tmp_path / "a.blend"
        assert bpy.ops.fdda.bake(filepath=str(out), action=action) == {"FINISHED"}
        assert_same_state(before, scene_state(find_rig()))
        pose(angle=0.7)
        assert_plays(bpy.data.objects[ELBOW], elbow_files.model)
        assert np.abs(read_pc2(tmp_path / "a.pc2")[2] - wave).max() < 1e-6
        shown = shown_without_add_on(tmp_path, (out, [12.0]))
        assert np.abs(shown[out, 12.0] - wave[11]).max() < POSITION_TOLERANCE

    def test_shape_keys_and_point_caches_are_baked(self, active, wave, tmp_path):
        assert bpy.ops.fdda.bake(filepath=str(tmp_path / "a.blend"), shape_keys=True) == {"FINISHED"}
        assert bpy.ops.fdda.bake(filepath=str(tmp_path / "b.pc2")) == {"FINISHED"}
        assert sorted(file_contents(tmp_path)) == ["a.blend", "b.pc2"]
        assert np.abs(read_pc2(tmp_path / "b.pc2")[2] - wave).max() < 1e-6

    @pytest.mark.parametrize("shape_keys", [False, True])
    def test_the_baked_file_has_the_baked_frames_and_no_model(self, active, elbow_files, tmp_path, shape_keys):
        bpy.ops.fdda.pack_model()
        scene, model_bytes = bpy.context.scene, active.fdda.models[0].packed_bytes
        scene.frame_start, scene.frame_end = 100, 120
        out = tmp_path / "a.blend"
        assert bpy.ops.fdda.bake(filepath=str(out), action="elbow_wave", shape_keys=shape_keys) == {"FINISHED"}
        assert (scene.frame_start, scene.frame_end) == (100, 120)
        assert active.fdda.packed == active.fdda.models[0].packed and active.fdda.packed is not None
        assert_plays(active, elbow_files.model)
        bpy.ops.wm.open_mainfile(filepath=str(out))
        assert (bpy.context.scene.frame_start, bpy.context.scene.frame_end) == (1, 30)
        assert not bpy.data.texts and not bpy.data.objects[ELBOW].fdda.models and model_bytes > 10_000

    def test_a_range_of_frames_is_baked(self, active, wave, tmp_path):
        options = {"use_frames": True, "frame_start": 5, "frame_end": 9}
        assert bpy.ops.fdda.bake(filepath=str(tmp_path / "a.pc2"), action="elbow_wave", **options) == {"FINISHED"}
        start, _, positions = read_pc2(tmp_path / "a.pc2")
        assert start == 5 and np.abs(positions - wave[4:9]).max() < 1e-6
        with pytest.raises(RuntimeError, match="There is nothing to bake from frame 9 to 5"):
            bpy.ops.fdda.bake(filepath=str(tmp_path / "b.pc2"), use_frames=True, frame_start=9, frame_end=5)

    def test_a_wrong_path_action_or_binding_is_refused(self, active, tmp_path):
        refused(bpy.ops.fdda.bake, "No file was chosen; give the name of a .pc2 or .blend file.")
        refused(lambda: bpy.ops.fdda.bake(filepath=str(tmp_path / "a.txt")), "ends in neither .pc2 nor .blend")
        refused(
            lambda: bpy.ops.fdda.bake(filepath=str(tmp_path / "a.pc2"), action="jump"), "The file has no action 'jump'"
        )
        bpy.ops.fdda.unbind()
        refused(lambda: bpy.ops.fdda.bake(filepath=str(tmp_path / "a.pc2")), "No model is bound; bind one first")
        assert file_contents(tmp_path) == {}

    @pytest.mark.parametrize(("mode", "strength"), [("FDDA", 0.4), ("LINEAR", 1.0)])
    def test_strength_and_mode_are_baked_as_the_viewport_shows_them(self, active, tmp_path, mode, strength):
        active.fdda.strength, active.fdda.mode = strength, mode
        assert bpy.ops.fdda.bake(filepath=str(tmp_path / "a.pc2")) == {"FINISHED"}
        bpy.context.scene.frame_set(12)
        shown = evaluated_positions(active)
        baked = read_pc2(tmp_path / "a.pc2")[2][12 - bpy.context.scene.frame_start]
        assert np.abs(baked - shown).max() < 1e-5
        active.fdda.strength, active.fdda.mode = 1.0, "FDDA"
        bpy.context.view_layer.update()
        assert np.abs(baked - evaluated_positions(active)).max() > 1e-4, "the pose tells the two apart"

    def test_an_animated_strength_is_baked_frame_by_frame(self, active, tmp_path):
        for frame, strength in ((1, 0.0), (20, 1.0)):
            active.fdda.strength = strength
            active.keyframe_insert("fdda.strength", frame=frame)
        assert bpy.ops.fdda.bake(filepath=str(tmp_path / "a.pc2")) == {"FINISHED"}
        baked = read_pc2(tmp_path / "a.pc2")[2]
        for frame in (1, 9, 20):
            bpy.context.scene.frame_set(frame)
            assert np.abs(baked[frame - bpy.context.scene.frame_start] - evaluated_positions(active)).max() < 1e-5


def test_no_operator_reuses_the_path_or_object_of_its_last_call():
    """Blender would fill missing arguments with those of the last call, and so overwrite another character's file."""
    from importlib import import_module

    from fdda_addon import operators

    classes = [c for name in operators.MODULES for c in import_module(f"fdda_addon.operators.{name}").CLASSES]
    names = [c.bl_idname.partition(".")[2] for c in classes if issubclass(c, bpy.types.Operator)]
    rna = [getattr(bpy.ops.fdda, name).get_rna_type() for name in names]
    subjects = {"FILE_PATH", "DIR_PATH"}
    found = [
        (kind.identifier, p.identifier, p.is_skip_save)
        for kind in rna
        for p in kind.properties
        if p.type == "STRING" and (p.subtype in subjects or p.identifier in {"object", "action", "bone"})
    ]
    assert len(found) > 20 and [entry for entry in found if not entry[2]] == []
