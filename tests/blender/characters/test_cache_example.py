# SPDX-License-Identifier: GPL-3.0-or-later
"""The example of docs/simulations.md: a model learns a cached deformation after the rig has lost its modifier."""

import json
import os
import subprocess
import sys
from pathlib import Path

import bpy
import pytest

from blend_fixtures.elbow import ACTION, FRAMES, build_elbow
from fdda_addon.core.formats.point_cache import PointCacheWriter
from fdda_addon.scene.blend_file import save_copy
from fdda_addon.scene.mesh import evaluated_positions

ROOT = Path(__file__).resolve().parents[3]
EXAMPLE = ROOT / "examples" / "cache" / "learn_from_cache.py"


def export_cache(path: Path, mesh_object: bpy.types.Object) -> None:
    """Export the animated mesh as Alembic or .pc2, by the suffix of the path."""
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 1, FRAMES
    for scene_object in scene.objects:
        scene_object.select_set(scene_object == mesh_object)
    if path.suffix == ".abc":
        bpy.ops.wm.alembic_export(filepath=str(path), selected=True, start=1, end=FRAMES)
        return
    with open(path, "wb") as file:
        writer = PointCacheWriter(file, len(mesh_object.data.vertices), 1, FRAMES)
        for frame in range(1, FRAMES + 1):
            scene.frame_set(frame)
            writer.append(evaluated_positions(mesh_object, bpy.context.evaluated_depsgraph_get())[None])
        writer.finish()
    scene.frame_set(1)


@pytest.mark.parametrize("suffix", ["abc", pytest.param("pc2", marks=pytest.mark.slow)])
def test_the_example_trains_a_model_of_a_cache(suffix, tmp_path):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    mesh_object, _ = build_elbow()
    cache, rig, out = tmp_path / f"elbow.{suffix}", tmp_path / "rig.blend", tmp_path / "out"
    export_cache(cache, mesh_object)
    mesh_object.modifiers.remove(mesh_object.modifiers["CorrectiveSmooth"])
    save_copy(rig)
    command = [sys.executable, EXAMPLE, rig, cache, out, "--object", "elbow", "--action", ACTION]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    errors = json.loads((out / "errors.json").read_text(encoding="utf-8"))
    assert errors["poses"] == FRAMES
    assert errors["fdda"]["mean"] < 0.15 * errors["linear"]["mean"]
