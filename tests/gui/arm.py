# SPDX-License-Identifier: GPL-3.0-or-later
"""Functions for the sample arm: look it up, open its file, frame it in the view, and compare its shapes."""

import importlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import bpy
import numpy as np
from window import redraw_window, region_override, require, view_area, wait_until

EXTENSION = "bl_ext.user_default.fdda"
BENT_FRAME = 110
"""Frame of the action at which shapes are compared: elbow and fingers are bent."""
BLEND_FILE_NAME = "arm.blend"
POSED_BONE, POSED_ANGLE = "wrist", 0.4
OTHER_OBJECT, OTHER_HEIGHT = "Camera", 3.25


def extension_module(name: str) -> ModuleType:
    """Import a module of the installed extension, given its name without the package."""
    return importlib.import_module(f"{EXTENSION}.fdda_addon.{name}")


def arm_object() -> bpy.types.Object:
    """Return the mesh object. It is looked up each time, because an undo and opening a file invalidate references."""
    return bpy.data.objects["arm"]


def armature_object() -> bpy.types.Object:
    """Return the armature object of the arm."""
    return bpy.data.objects["arm_rig"]


def make_empty_folder(folder: Path) -> Path:
    """Create a folder, without the files of an earlier run, and return it."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder


def open_copy_in(target_folder: Path, pictures_folder: Path) -> Iterator[float]:
    """Copy the file of the story `path` into another folder, open the copy, and check that its model plays."""
    shutil.copy(pictures_folder / "work" / BLEND_FILE_NAME, make_empty_folder(target_folder) / BLEND_FILE_NAME)
    bpy.ops.wm.open_mainfile(filepath=str(target_folder / BLEND_FILE_NAME), load_ui=False)
    yield 1.0
    check_model_plays()
    frame_object(arm_object())


def check_model_plays() -> None:
    """Check that the model deforms the arm and has no problem."""
    require(
        arm_object().fdda.mode == "FDDA" and not arm_object().fdda.status,
        f"it plays {arm_object().fdda.mode}: {arm_object().fdda.status}",
    )


def frame_object(mesh_object: bpy.types.Object, distance_factor: float = 1.0) -> None:
    """Make an object active and frame it in the view, at `distance_factor` times the distance that fits it."""
    with region_override("WINDOW"):
        bpy.ops.object.select_all(action="DESELECT")
        mesh_object.select_set(True)
        bpy.context.view_layer.objects.active = mesh_object
        bpy.ops.view3d.view_selected()
    view_area().spaces[0].region_3d.view_distance *= distance_factor


def evaluated_positions(mesh_object: bpy.types.Object) -> np.ndarray:
    """Return the evaluated vertex positions of an object in the current frame: (V, 3) float32, meters."""
    mesh = mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    vertex_positions = np.empty((len(mesh.vertices), 3), np.float32)
    mesh.attributes["position"].data.foreach_get("vector", vertex_positions.reshape(-1))
    return vertex_positions


def arm_positions(frame: int = BENT_FRAME) -> np.ndarray:
    """Return the evaluated vertex positions of the arm at a frame of its action: (V, 3) float32, meters."""
    bpy.context.scene.frame_set(frame)
    return evaluated_positions(arm_object())


def pose_without_keyframe() -> None:
    """At `BENT_FRAME`, rotate a keyed bone and move another keyed object, without keyframes."""
    other = bpy.data.objects[OTHER_OBJECT]
    if other.animation_data is None:
        other.keyframe_insert("location", frame=1)
    bpy.context.scene.frame_set(BENT_FRAME)
    require(not has_unkeyed_pose(), "the keyframes have the pose, too")
    armature_object().pose.bones[POSED_BONE].rotation_euler[0] = POSED_ANGLE
    other.location[2] = OTHER_HEIGHT


def has_unkeyed_pose() -> bool:
    """Return whether the bone has the angle that `pose_without_keyframe` has set."""
    return abs(armature_object().pose.bones[POSED_BONE].rotation_euler[0] - POSED_ANGLE) < 1e-6


def require_unkeyed_pose(deed: str) -> None:
    """Check that bone and object are where `pose_without_keyframe` has put them."""
    require(has_unkeyed_pose(), f"{deed} rotates the bone without a keyframe")
    height = bpy.data.objects[OTHER_OBJECT].location[2]
    require(height == OTHER_HEIGHT, f"{deed} moves the object without a keyframe to {height}")


def mean_distance_mm(first_positions: np.ndarray, second_positions: np.ndarray) -> float:
    """Return the mean distance between corresponding vertices, mm."""
    return float(np.linalg.norm(first_positions - second_positions, axis=1).mean()) * 1000


def show_preferences(area: bpy.types.Area) -> Iterator[float]:
    """Turn an area into the preferences, with the add-on's own unfolded."""
    import addon_utils

    area.type = "PREFERENCES"
    bpy.context.preferences.active_section = "ADDONS"
    bpy.context.window_manager.addon_search = "FDDA"
    module = next(m for m in addon_utils.modules() if m.__name__ == EXTENSION)
    addon_utils.module_bl_info(module)["show_expanded"] = True
    yield from redraw_window()


def wait_for_job(verb: str, seconds: float) -> Iterator[float]:
    """Wait until the job that a button has started ends, and check that it was successful."""
    job = extension_module("jobs.job")
    yield from wait_until(lambda: job.state_of(verb) is not None, 10, f"the button starts no job {verb}")
    yield from wait_until(lambda: not job.state_of(verb).is_running, seconds, f"the job {verb} does not end")
    state = job.state_of(verb)
    require(state.outcome_level == "INFO", f"the job {verb} ended with '{state.outcome}'")
