# SPDX-License-Identifier: GPL-3.0-or-later
"""The example of docs/simulations.md: a model learns a cached deformation after the rig has lost its modifier."""

import json
import os
import subprocess
import sys
from pathlib import Path

import bpy

from blend_fixtures.elbow import ACTION, FRAMES, build_elbow
from fdda_addon.scene.blend_file import save_copy

ROOT = Path(__file__).resolve().parents[3]
EXAMPLE = ROOT / "examples" / "cache" / "learn_from_cache.py"


def export_cache(path: Path, mesh_object: bpy.types.Object) -> None:
    """Export the animated mesh as Alembic."""
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 1, FRAMES
    for scene_object in scene.objects:
        scene_object.select_set(scene_object == mesh_object)
    bpy.ops.wm.alembic_export(filepath=str(path), selected=True, start=1, end=FRAMES)


def test_the_example_trains_a_model_of_a_cache(tmp_path):
    mesh_object, _ = build_elbow()
    cache, rig, out = tmp_path / "elbow.abc", tmp_path / "rig.blend", tmp_path / "out"
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
