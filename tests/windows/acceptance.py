# SPDX-License-Identifier: GPL-3.0-or-later
"""From the rig to a bake, in folders as Windows' users have them: blanks, an ampersand, letters of no code page.

`python -m pytest tests/windows/acceptance.py` runs it, on Windows and elsewhere. Each verb is a process of its own. The
user's folder and the folder of temporary files have such names too.
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
USER, FOLDER = "Jürgen Müller 李", "my rig & co"
POSES, MORE_POSES, EPOCHS = 60, 40, 3
PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The character's folder, in the folder of a user."""
    folder = tmp_path_factory.mktemp("Users") / USER / FOLDER
    folder.mkdir(parents=True)
    return folder


def run(folder: Path, verb: str, *arguments: object) -> str:
    """Run a verb, which has to succeed without a traceback or a warning of Python; returns what it prints."""
    user = folder.parent
    (user / "Temp").mkdir(exist_ok=True)
    names = ("HOME", "USERPROFILE", "APPDATA", "LOCALAPPDATA", "BLENDER_USER_RESOURCES")
    variables = dict.fromkeys(names, str(user)) | dict.fromkeys(("TMP", "TEMP", "TMPDIR"), str(user / "Temp"))
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


def test_from_the_rig_to_a_bake(folder: Path):
    """One test: each verb reads what the one before wrote."""
    rig, recording, model = folder / "arm.blend", folder / "recording", folder / "arm.onnx"
    run(folder, "build-arm", rig)
    run(folder, "record", rig, recording, "--poses", POSES)
    run(folder, "train", recording, model, "--epochs", EPOCHS)
    first = model.read_bytes()
    held_out = json.loads((folder / "report.json").read_text(encoding="utf-8"))["fdda"]["held_out"]
    # Missed by the first training, which is the same again, and met once there are more poses.
    goal = ("--goal-mm", 0.95 * held_out["p999"], "--poses", MORE_POSES)
    run(folder, "train", recording, model, "--epochs", EPOCHS, "--refine", rig, *goal)
    assert len(np.load(next(recording.glob("*pose*.npy")), mmap_mode="r")) >= POSES + MORE_POSES
    assert model.read_bytes() != first

    run(folder, "bind", rig, model, folder / "bound.blend")
    errors, heat_map, times = folder / "errors.json", folder / "errors.png", folder / "times.json"
    run(folder, "evaluate", rig, model, "--json", errors, "--heatmap", heat_map, "--poses", 10)
    assert json.loads(errors.read_text(encoding="utf-8"))
    assert heat_map.read_bytes().startswith(PNG)
    run(folder, "benchmark", rig, model, "--json", times, "--frames", 5)
    assert json.loads(times.read_text(encoding="utf-8"))
    run(folder, "bake", rig, model, folder / "baked.blend", "--frames", 1, 5)
    bpy.ops.wm.open_mainfile(filepath=str(folder / "baked.blend"))
    assert any(modifier.type == "MESH_CACHE" for item in bpy.data.objects for modifier in item.modifiers)
