# SPDX-License-Identifier: GPL-3.0-or-later
"""What baked files hold and show, found without the add-on."""

import json
import struct
import subprocess
import sys
from pathlib import Path

import bpy
import numpy as np

from .conftest import ELBOW, ElbowFiles, predicted

WAVE_FRAMES = range(1, 31)
"""Frames of the elbow's action."""
POSITION_TOLERANCE = 1e-5
"""Metres."""

PLAIN_BLENDER = """
import json, sys
import bpy
import numpy as np

out, *jobs = sys.argv[1:]
found = {}
for job in jobs:
    path, times = json.loads(job)
    bpy.ops.wm.open_mainfile(filepath=path)
    mesh_object = bpy.data.objects["elbow"]
    assert not hasattr(mesh_object, "fdda") and not any("fdda" in name for name in sys.modules)
    for time in times:
        bpy.context.scene.frame_set(int(time // 1), subframe=time % 1)
        mesh = mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
        found[f"{len(found)}"] = np.array([vertex.co[:] for vertex in mesh.vertices])
np.savez(out, **found)
"""


def shown_without_add_on(folder: Path, *jobs: tuple[Path, list[float]]) -> dict[tuple[Path, float], np.ndarray]:
    """What files show at some times, in a process that has `bpy` and not the add-on."""
    out, arguments = folder / "plain.npz", [json.dumps([str(path), times]) for path, times in jobs]
    command = [sys.executable, "-I", "-c", PLAIN_BLENDER, str(out), *arguments]
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    with np.load(out) as arrays:
        asked = [(path, time) for path, times in jobs for time in times]
        found = {one: arrays[f"{number}"] for number, one in enumerate(asked)}
    out.unlink()
    return found


def read_pc2(path: Path) -> tuple[float, float, np.ndarray]:
    """First frame, frames a sample and positions, by the description of the format alone."""
    data = path.read_bytes()
    assert data[:12] == b"POINTCACHE2\0" and struct.unpack_from("<i", data, 12) == (1,)
    points, start, rate, samples = struct.unpack_from("<iffi", data, 16)
    assert len(data) == 32 + samples * points * 12
    return start, rate, np.frombuffer(data, "<f4", offset=32).reshape(samples, points, 3)


def predicted_in_frames(frames, model: Path) -> np.ndarray:
    """(N, V, 3), the model's positions in frames of the open file, one by one."""
    found = []
    for frame in frames:
        bpy.context.scene.frame_set(frame)
        found.append(predicted(bpy.data.objects[ELBOW], model).copy())
    return np.array(found)


def predicted_wave(elbow: ElbowFiles) -> np.ndarray:
    """(30, V, 3), what the model makes of the elbow's action."""
    bpy.ops.wm.open_mainfile(filepath=str(elbow.rig))
    return predicted_in_frames(WAVE_FRAMES, elbow.model)
