# SPDX-License-Identifier: GPL-3.0-or-later
"""The operator that bakes what is bound."""

import bpy
import numpy as np
import pytest
from baked_files import CLOSE, elbow_wave, plain_blender, read_pc2
from conftest import ELBOW, assert_plays, pose
from refusals import files
from scene_state import assert_same_state, scene_state
from test_operators_playback import refused

from fdda_addon.scene.rig import find_rig


@pytest.fixture(scope="module")
def wave(elbow) -> np.ndarray:
    return elbow_wave(elbow)


class TestOperator:
    @pytest.fixture
    def active(self, bound):
        bpy.context.view_layer.objects.active = bound
        return bound

    @pytest.mark.parametrize("action", ["elbow_wave", ""])
    def test_what_is_bound_is_baked_and_plays_on(self, active, elbow, wave, tmp_path, action):
        before = scene_state(find_rig())
        out = tmp_path / "a.blend"
        assert bpy.ops.fdda.bake(filepath=str(out), action=action) == {"FINISHED"}
        assert_same_state(before, scene_state(find_rig()))
        pose(angle=0.7)
        assert_plays(bpy.data.objects[ELBOW], elbow.model)
        assert np.abs(read_pc2(tmp_path / "a.pc2")[2] - wave).max() < 1e-6
        shown = plain_blender(tmp_path, (out, [12.0]))
        assert np.abs(shown[out, 12.0] - wave[11]).max() < CLOSE

    def test_shape_keys_and_point_caches(self, active, wave, tmp_path):
        assert bpy.ops.fdda.bake(filepath=str(tmp_path / "a.blend"), shape_keys=True) == {"FINISHED"}
        assert bpy.ops.fdda.bake(filepath=str(tmp_path / "b.pc2")) == {"FINISHED"}
        assert sorted(files(tmp_path)) == ["a.blend", "b.pc2"]
        assert np.abs(read_pc2(tmp_path / "b.pc2")[2] - wave).max() < 1e-6

    def test_refusals(self, active, tmp_path):
        refused(bpy.ops.fdda.bake, "No file was chosen; give the name of a .pc2 or .blend file.")
        refused(lambda: bpy.ops.fdda.bake(filepath=str(tmp_path / "a.txt")), "ends in neither .pc2 nor .blend")
        refused(
            lambda: bpy.ops.fdda.bake(filepath=str(tmp_path / "a.pc2"), action="jump"), "The file has no action 'jump'"
        )
        bpy.ops.fdda.unbind()
        refused(lambda: bpy.ops.fdda.bake(filepath=str(tmp_path / "a.pc2")), "No model is bound; bind one first")
        assert files(tmp_path) == {}
