# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes that fail with one error message and leave no incomplete file."""

import re
import shutil

import bpy
import numpy as np
import pytest

from ..conftest import run
from ..refusals import file_contents, limited_file_size, save_elbow


class TestRefusals:
    def test_a_missing_action_is_refused(self, refusal, elbow_files, tmp_path):
        text = refusal("bake", elbow_files.rig, elbow_files.model, tmp_path / "a.pc2", "--action", "jump")
        assert text == "The file has no action 'jump'; its actions: 'elbow_wave'."

    def test_a_model_of_another_rig_is_refused(self, refusal, elbow_files, tmp_path):
        def move_vertex(rig):
            rig.mesh_object.data.vertices[0].co.x += 0.01

        rig = save_elbow(tmp_path / "rig.blend", move_vertex)
        assert f"The model '{elbow_files.model}' was trained for another rig: " in refusal(
            "bake", rig, elbow_files.model, tmp_path / "a.pc2"
        )

    def test_a_missing_model_is_refused(self, refusal, elbow_files, tmp_path):
        assert "none.onnx' cannot be read" in refusal(
            "bake", elbow_files.rig, tmp_path / "none.onnx", tmp_path / "a.pc2"
        )

    @pytest.mark.parametrize(
        ("out", "options", "words"),
        [
            ("a.abc", [], "a.abc' ends in neither .pc2 nor .blend; give it the extension of what to write."),
            ("a", [], "ends in neither .pc2 nor .blend"),
            ("a.pc2", ["--shape-keys"], "Shape keys are written into a .blend file; give '"),
            ("a.pc2", ["--frames", 9, 8], "There is nothing to bake from frame 9 to 8; give the first frame first."),
            ("a.pc2", ["--frames", 1, 2000000], "Blender has frames up to 1048574, not from 1 to 2000000; give fewer."),
        ],
    )
    def test_wrong_options_end_with_status_2(self, elbow_files, tmp_path, capfd, out, options, words):
        assert run("bake", elbow_files.rig, elbow_files.model, tmp_path / out, *options) == 2
        captured = capfd.readouterr()
        assert words in captured.err and captured.err.count("\n") == 1 and not captured.out
        assert file_contents(tmp_path) == {}

    def test_an_output_that_is_the_rig_s_file_is_refused(self, refusal, elbow_files, tmp_path):
        rig = shutil.copy(elbow_files.rig, tmp_path / "rig.blend")
        text = refusal("bake", rig, elbow_files.model, rig)
        assert text == f"Cannot write '{rig}': it is read for this; give another name, or --overwrite."

    def test_a_point_cache_that_cannot_be_written_is_refused(self, refusal, elbow_files, tmp_path):
        (tmp_path / "a.pc2").mkdir()
        text = refusal("bake", elbow_files.rig, elbow_files.model, tmp_path / "a.blend")
        assert text == f"Cannot write '{tmp_path / 'a.pc2'}': it is a folder; give the name of a file."

    def test_a_missing_folder_is_refused(self, refusal, elbow_files, tmp_path):
        assert "does not exist; create it first." in refusal(
            "bake", elbow_files.rig, elbow_files.model, tmp_path / "b" / "a.pc2"
        )

    @pytest.mark.parametrize(("out", "options"), [("a.pc2", []), ("a.blend", []), ("a.blend", ["--shape-keys"])])
    @pytest.mark.parametrize("limit", [100, 60_000, 150_000])
    def test_a_full_disk_leaves_the_old_files(self, refusal_on_a_full_disk, elbow_files, tmp_path, out, options, limit):
        """The limit is reached at once, while positions are written, or in the .blend file."""
        if limit > 100_000 and out == "a.pc2":
            pytest.skip("this file contains only positions")

        def add_random_data(_rig):
            # Random data exceeds the limit even in a compressed file.
            bpy.context.scene["noise"] = np.random.default_rng(0).bytes(200_000).hex()

        rig = save_elbow(tmp_path / "rig.blend", add_random_data)
        for name in ("a.pc2", "a.blend"):
            (tmp_path / name).write_text("old")
        with limited_file_size(limit):
            text = refusal_on_a_full_disk("bake", rig, elbow_files.model, tmp_path / out, *options)
        assert re.match(f"Cannot write '{tmp_path / 'a'}.", text)

    def test_a_modifier_that_changes_the_topology_before_the_armature_is_refused(self, refusal, elbow_files, tmp_path):
        def add_subdivision(rig):
            rig.mesh_object.modifiers.new("Changes", "SUBSURF")
            rig.mesh_object.modifiers.move(2, 0)

        rig = save_elbow(tmp_path / "rig.blend", add_subdivision)
        assert "Modifier 'Changes' of 'elbow' changes the topology of the mesh before" in refusal(
            "bake", rig, elbow_files.model, tmp_path / "a.blend"
        )

    def test_an_armature_in_rest_position_is_refused(self, refusal, elbow_files, tmp_path):
        rig = save_elbow(tmp_path / "rig.blend", lambda rig: setattr(rig.armature_object.data, "pose_position", "REST"))
        assert "shows its rest position; set it to pose." in refusal("bake", rig, elbow_files.model, tmp_path / "a.pc2")
