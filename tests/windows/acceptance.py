# SPDX-License-Identifier: GPL-3.0-or-later
"""All verbs from the rig to a bake, in folders whose names have spaces, an ampersand and Unicode letters.

`python -m pytest tests/windows/acceptance.py` runs it, on Windows and elsewhere. Each verb runs in its own process. The
home folder and the folder of temporary files have such names too.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import bpy
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
USER_NAME, CHARACTER_FOLDER_NAME = "Jürgen Müller 李", "my rig & co"
POSE_COUNT, ADDED_POSE_COUNT, EPOCH_COUNT = 60, 40, 3
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the character, inside the home folder of a user."""
    folder = tmp_path_factory.mktemp("Users") / USER_NAME / CHARACTER_FOLDER_NAME
    folder.mkdir(parents=True)
    return folder


def run_verb(folder: Path, verb: str, *arguments: object) -> str:
    """Run a verb, check that it succeeds without a traceback or Python warning, and return its output."""
    home_folder = folder.parent
    (home_folder / "Temp").mkdir(exist_ok=True)
    variable_names = ("HOME", "USERPROFILE", "APPDATA", "LOCALAPPDATA", "BLENDER_USER_RESOURCES")
    variables = dict.fromkeys(variable_names, str(home_folder)) | dict.fromkeys(
        ("TMP", "TEMP", "TMPDIR"), str(home_folder / "Temp")
    )
    command = [sys.executable, "-m", "fdda_addon", verb, *map(str, arguments)]
    result = subprocess.run(
        command,
        cwd=ROOT,
        env={**os.environ, **variables, "PYTHONUTF8": "1", "FDDA_TRAINER_PYTHON": sys.executable},
        capture_output=True,
        encoding="utf-8",
        check=False,
        timeout=1800,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    assert "Traceback" not in result.stderr and "Warning" not in result.stderr, result.stderr
    return result.stdout


def test_verbs_from_the_rig_to_a_bake(folder: Path):
    """This is one test because each verb reads the files of the previous one."""
    rig, recording, model = folder / "arm.blend", folder / "recording", folder / "arm.onnx"
    run_verb(folder, "build-arm", rig)
    run_verb(folder, "record", rig, recording, "--poses", POSE_COUNT)
    run_verb(folder, "train", recording, model, "--passes", EPOCH_COUNT)
    first_model_bytes = model.read_bytes()
    held_out_errors = json.loads((folder / "report.json").read_text(encoding="utf-8"))["fdda"]["held_out"]
    # The same training misses this goal, so poses are added.
    goal_options = ("--goal-mm", 0.95 * held_out_errors["p999"], "--poses", ADDED_POSE_COUNT)
    run_verb(folder, "train", recording, model, "--passes", EPOCH_COUNT, "--refine", rig, *goal_options)
    assert len(np.load(next(recording.glob("*pose*.npy")), mmap_mode="r")) >= POSE_COUNT + ADDED_POSE_COUNT
    assert model.read_bytes() != first_model_bytes

    run_verb(folder, "bind", rig, model, folder / "bound.blend")
    errors_path, heat_map_path, times_path = folder / "errors.json", folder / "errors.png", folder / "times.json"
    run_verb(folder, "evaluate", rig, model, "--json", errors_path, "--heatmap", heat_map_path, "--poses", 10)
    assert json.loads(errors_path.read_text(encoding="utf-8"))
    assert heat_map_path.read_bytes().startswith(PNG_SIGNATURE)
    run_verb(folder, "benchmark", rig, model, "--json", times_path, "--frames", 5)
    assert json.loads(times_path.read_text(encoding="utf-8"))
    run_verb(folder, "bake", rig, model, folder / "baked.blend", "--frames", 1, 5)
    bpy.ops.wm.open_mainfile(filepath=str(folder / "baked.blend"))
    assert any(
        modifier.type == "MESH_SEQUENCE_CACHE"
        for scene_object in bpy.data.objects
        for modifier in scene_object.modifiers
    )
