# SPDX-License-Identifier: GPL-3.0-or-later
"""Steps of the story `path`: the sidebar is found, and the arm is added and measured. Each function is a step."""

import os
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
import sidebar
from arm import (
    BLEND_FILE_NAME,
    EXTENSION,
    arm_object,
    armature_object,
    extension_module,
    wait_for_job,
)
from window import (
    redraw_window,
    region_override,
    require,
    save_screenshot,
    view_area,
    view_region,
    wait_until,
)

SMALL_VERTICES, DEFAULT_VERTICES, BONE_COUNT = 1476, 9960, 22
MODIFIERS = ["ARMATURE", "CORRECTIVE_SMOOTH"]


def extent_in_view() -> float:
    """Return the larger of the arm's width and height relative to the viewport; 2 if a part is outside of it."""
    from bpy_extras.view3d_utils import location_3d_to_region_2d
    from mathutils import Vector

    view, region3d = view_region("WINDOW"), view_area().spaces[0].region_3d
    points = [
        location_3d_to_region_2d(view, region3d, arm_object().matrix_world @ Vector(corner))
        for corner in arm_object().bound_box
    ]
    require(all(points), "a part of the arm is behind the viewer")
    is_in_view = all(0 <= p.x <= view.width and 0 <= p.y <= view.height for p in points)
    width, height = (np.ptp([p[axis] for p in points]) for axis in range(2))
    return float(max(width / view.width, height / view.height)) if is_in_view else 2.0


def find_the_sidebar(_folder: Path) -> Iterator[float]:
    """Check that the installed extension is enabled, and open its tab in the sidebar."""
    require(EXTENSION in bpy.context.preferences.addons, f"{EXTENSION} is not enabled")
    module_path = Path(extension_module("jobs.job").__file__)
    user_folder = Path(os.environ["BLENDER_USER_RESOURCES"])
    require(
        module_path.is_relative_to(user_folder),
        f"the add-on comes from {module_path}, not from what was installed into {user_folder}",
    )
    yield from sidebar.open_tab()
    opened = yield from sidebar.list_open_sections()
    require(opened == {"rig"}, f"without a rig only the section Rig should be shown, not {sorted(opened)}")


def add_the_arm(folder: Path) -> Iterator[float]:
    """Press Add Sample Arm, and save the file."""
    cube = bpy.data.objects["Cube"]
    cube.select_set(False)
    bpy.context.view_layer.objects.active = None
    yield from redraw_window()
    yield from sidebar.press_button("fdda.add_sample_arm")
    yield from wait_until(lambda: "arm" in bpy.data.objects, 20, "no arm is added")
    require(not cube.visible_get(), "the default cube is still visible")
    require(
        len(arm_object().data.vertices) == DEFAULT_VERTICES, f"the arm has {len(arm_object().data.vertices)} vertices"
    )
    yield from save_screenshot(folder / "framed.png")
    require(0.4 < extent_in_view() < 1.0, f"the arm takes {extent_in_view():.2f} of the view's height or width")
    # The following steps are faster with the small arm.
    bpy.ops.ed.undo()
    yield 0.5
    bpy.ops.fdda.add_sample_arm(density="1")
    bpy.ops.ed.undo_push(message="arm")
    require(bpy.context.view_layer.objects.active == arm_object(), "the arm is not the active object")
    require(
        len(arm_object().data.vertices) == SMALL_VERTICES, f"the arm has {len(arm_object().data.vertices)} vertices"
    )
    require(len(bpy.data.objects["arm_rig"].pose.bones) == BONE_COUNT, "the armature has other joints")
    require([m.type for m in arm_object().modifiers] == MODIFIERS, "the arm has other modifiers")
    with region_override("WINDOW"):
        bpy.ops.view3d.view_selected()
    yield 0.5
    yield from save_screenshot(folder / "not_saved.png")
    file_problem = extension_module("properties.character").file_problem
    require(file_problem(arm_object()).startswith("Save the .blend"), "nothing says that the file is not saved")
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "work" / BLEND_FILE_NAME))
    require(not file_problem(arm_object()), f"after saving it says '{file_problem(arm_object())}'")


def measure_the_rig(_folder: Path) -> Iterator[float]:
    """Press Measure Speed in the section Rig."""
    yield from sidebar.open_section("rig")
    yield from sidebar.press_button("fdda.measure()")
    yield from wait_for_job("measure", 40)
    times = extension_module("timing.measurements").last("measure", armature_object())
    rig_ms, linear_ms = times.median("rig"), times.median("linear")
    require(0 < linear_ms < rig_ms, f"the armature alone takes {linear_ms} ms and the whole rig {rig_ms}")
