# SPDX-License-Identifier: GPL-3.0-or-later
"""Functions that read baked files without the add-on, and the positions that the files must contain."""

import json
import struct
import subprocess
import sys
from pathlib import Path

import bpy
import numpy as np

from .conftest import ELBOW, ElbowFiles, predicted_positions

WAVE_FRAMES = range(1, 31)
"""Frames of the action `elbow_wave`."""
POSITION_TOLERANCE = 1e-5
"""Largest distance between two positions that count as equal, in meters."""

CODE_WITHOUT_ADD_ON = """
import json, sys
import bpy
import numpy as np

out, *jobs = sys.argv[1:]
positions = {}
for job in jobs:
    path, times = json.loads(job)
    bpy.ops.wm.open_mainfile(filepath=path)
    mesh_object = bpy.data.objects["elbow"]
    assert not hasattr(mesh_object, "fdda") and not any("fdda" in name for name in sys.modules)
    for time in times:
        bpy.context.scene.frame_set(int(time // 1), subframe=time % 1)
        mesh = mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
        positions[f"{len(positions)}"] = np.array([vertex.co[:] for vertex in mesh.vertices])
np.savez(out, **positions)
"""


def shown_without_add_on(folder: Path, *jobs: tuple[Path, list[float]]) -> dict[tuple[Path, float], np.ndarray]:
    """Return the positions that files show at given frames, in a process that has `bpy` but not the add-on.

    Args:
        folder: for temporary files.
        jobs: path of each file, and the frames to evaluate; fractions are subframes.

    Returns:
        Positions (V, 3), by path and frame.
    """
    out, arguments = folder / "plain.npz", [json.dumps([str(path), times]) for path, times in jobs]
    command = [sys.executable, "-I", "-c", CODE_WITHOUT_ADD_ON, str(out), *arguments]
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    with np.load(out) as arrays:
        requests = [(path, time) for path, times in jobs for time in times]
        positions = {request: arrays[f"{index}"] for index, request in enumerate(requests)}
    out.unlink()
    return positions


def read_pc2(path: Path) -> tuple[float, float, np.ndarray]:
    """Read a .pc2 file as its format is documented: first frame, frames per sample, positions (N, V, 3)."""
    data = path.read_bytes()
    assert data[:12] == b"POINTCACHE2\0" and struct.unpack_from("<i", data, 12) == (1,)
    points, start, rate, samples = struct.unpack_from("<iffi", data, 16)
    assert len(data) == 32 + samples * points * 12
    return start, rate, np.frombuffer(data, "<f4", offset=32).reshape(samples, points, 3)


def predicted_in_frames(frames, model: Path) -> np.ndarray:
    """Return the model's positions (N, V, 3) in frames of the open file."""
    positions = []
    for frame in frames:
        bpy.context.scene.frame_set(frame)
        positions.append(predicted_positions(bpy.data.objects[ELBOW], model).copy())
    return np.array(positions)


def predicted_wave(elbow_files: ElbowFiles) -> np.ndarray:
    """Return the model's positions (30, V, 3) in all frames of the action `elbow_wave`."""
    bpy.ops.wm.open_mainfile(filepath=str(elbow_files.rig))
    return predicted_in_frames(WAVE_FRAMES, elbow_files.model)
