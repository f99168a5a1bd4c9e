# SPDX-License-Identifier: GPL-3.0-or-later
"""Functions that read baked files, and the positions that the files must contain."""

from collections.abc import Iterable
from pathlib import Path

import bpy
import numpy as np

from fdda_addon.runtime.binding import bind
from fdda_addon.scene.scene_rig import find_rig

from .conftest import ELBOW, evaluated_positions, predicted_positions


def predicted_in_frames(frames, model: Path) -> np.ndarray:
    """Return the model's positions (N, V, 3) in frames of the open file."""
    positions = []
    for frame in frames:
        bpy.context.scene.frame_set(frame)
        positions.append(predicted_positions(bpy.data.objects[ELBOW], model).copy())
    return np.array(positions)


def world_positions(mesh_object: bpy.types.Object, frames: Iterable[float]) -> np.ndarray:
    """Return the evaluated positions (N, V, 3) of an object in frames, in world space; fractions are subframes."""
    positions = []
    for frame in frames:
        bpy.context.scene.frame_set(int(frame // 1), subframe=frame % 1)
        evaluated = mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get())
        matrix = np.array(evaluated.matrix_world)
        positions.append(evaluated_positions(mesh_object) @ matrix[:3, :3].T + matrix[:3, 3])
    return np.array(positions)


def shown_by_model(rig: Path, model: Path, frames: Iterable[float]) -> np.ndarray:
    """Return the positions (N, V, 3) that the model shows in frames of a file, in world space."""
    bpy.ops.wm.open_mainfile(filepath=str(rig))
    bind(find_rig(), model)
    return world_positions(find_rig().mesh_object, frames)


def import_baked(path: Path) -> dict[str, bpy.types.Object]:
    """Import a baked Alembic or USD file into an empty file; return its mesh objects by name."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    importer = bpy.ops.wm.alembic_import if path.suffix == ".abc" else bpy.ops.wm.usd_import
    assert importer(filepath=str(path)) == {"FINISHED"}
    return {o.name: o for o in bpy.data.objects if o.type == "MESH"}


def read_baked(path: Path, frames: Iterable[int]) -> np.ndarray:
    """Return the positions (N, V, 3) of the only mesh of a baked Alembic or USD file, in object space."""
    (mesh_object,) = import_baked(path).values()
    positions = []
    for frame in frames:
        bpy.context.scene.frame_set(frame)
        positions.append(evaluated_positions(mesh_object).copy())
    return np.array(positions)
