# SPDX-License-Identifier: GPL-3.0-or-later
"""The arm of the stories: found, opened, looked at, and compared with what it was."""

import importlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import bpy
import numpy as np
from window import check, over, until, view_area

EXTENSION = "bl_ext.user_default.fdda"
FRAME = 110
"""Of the action, with elbow and fingers bent: where shapes are compared."""
BLEND = "arm.blend"


def part(name: str) -> ModuleType:
    """A module of the installed extension."""
    return importlib.import_module(f"{EXTENSION}.fdda_addon.{name}")


def arm() -> bpy.types.Object:
    """The mesh: looked up each time, as an undo or another file makes references invalid."""
    return bpy.data.objects["arm"]


def armature() -> bpy.types.Object:
    """What moves it."""
    return bpy.data.objects["arm_rig"]


def emptied(own: Path) -> Path:
    """The folder, without what an earlier run has left there."""
    shutil.rmtree(own, ignore_errors=True)
    own.mkdir()
    return own


def open_in(own: Path, folder: Path) -> Iterator[float]:
    """Open the file that the path of a first model has left, copied into a folder of its own; the model plays."""
    shutil.copy(folder / "work" / BLEND, emptied(own) / BLEND)
    bpy.ops.wm.open_mainfile(filepath=str(own / BLEND), load_ui=False)
    yield 1.0
    check_it_plays()
    look_at(arm())


def check_it_plays() -> None:
    """Fail where the model does not deform the arm, or something is odd about it."""
    check(arm().fdda.mode == "FDDA" and not arm().fdda.status, f"it plays {arm().fdda.mode}: {arm().fdda.status}")


def look_at(mesh_object: bpy.types.Object, times: float = 1.0) -> None:
    """Make an object the active one, and have it fill the view, or a part of it."""
    with over("WINDOW"):
        bpy.ops.object.select_all(action="DESELECT")
        mesh_object.select_set(True)
        bpy.context.view_layer.objects.active = mesh_object
        bpy.ops.view3d.view_selected()
    view_area().spaces[0].region_3d.view_distance *= times


def positions(mesh_object: bpy.types.Object) -> np.ndarray:
    """(V, 3) metres: what Blender shows of an object as it stands."""
    mesh = mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    found = np.empty((len(mesh.vertices), 3), np.float32)
    mesh.attributes["position"].data.foreach_get("vector", found.reshape(-1))
    return found


def shape(frame: int = FRAME) -> np.ndarray:
    """(V, 3) metres: what Blender shows of the arm at a frame of its action."""
    bpy.context.scene.frame_set(frame)
    return positions(arm())


def distance_mm(one: np.ndarray, other: np.ndarray) -> float:
    """Mean distance of vertices."""
    return float(np.linalg.norm(one - other, axis=1).mean()) * 1000


def job_done(verb: str, seconds: float) -> Iterator[float]:
    """Wait until the job that a button started has ended well."""
    job = part("jobs.job")
    yield from until(lambda: job.state_of(verb) is not None, 10, f"the button starts no job {verb}")
    yield from until(lambda: not job.state_of(verb).is_running, seconds, f"the job {verb} does not end")
    state = job.state_of(verb)
    check(state.outcome_level == "INFO", f"the job {verb} ended with '{state.outcome}'")
