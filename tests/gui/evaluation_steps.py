# SPDX-License-Identifier: GPL-3.0-or-later
"""Steps of the story `path`: the model is compared with the rig. Each function is a step."""

from collections.abc import Iterator
from pathlib import Path

import bpy
import sidebar
from arm import (
    BENT_FRAME,
    arm_object,
    extension_module,
    pose_without_keyframe,
    require_unkeyed_pose,
)
from window import (
    colored_ratio,
    region_override,
    require,
    save_screenshot,
    view_area,
    wait_until,
)

FRAME_COUNT = 250
MIN_COLORED_RATIO = 0.01
"""Smallest ratio of colored pixels in the viewport when the arm has colors; without colors it is 0.001."""


def evaluate(_folder: Path) -> Iterator[float]:
    """Press Evaluate: the model is compared with the rig in each frame of the active action."""
    yield from sidebar.open_section("evaluation")
    pose_without_keyframe()
    yield from sidebar.press_button("fdda.evaluate")
    evaluations = extension_module("evaluation.last_evaluation")
    yield from wait_until(lambda: evaluations.get(arm_object()) is not None, 90, "nothing is evaluated")
    yield 0.3
    require_unkeyed_pose("Evaluate")
    bpy.context.scene.frame_set(BENT_FRAME)
    last = evaluations.get(arm_object())
    require(last.poses == FRAME_COUNT, f"{last.poses} frames are compared")
    fdda, linear = last.total["fdda"].mean, last.total["linear"].mean
    require(0 < fdda < linear, f"the model is {fdda} mm from the rig and linear skinning {linear}")


def show_the_heat_map(folder: Path) -> Iterator[float]:
    """Press Heat Map: the arm shows the errors as colors."""
    yield from _show_colors("ERRORS", folder)


def show_the_partitions(folder: Path) -> Iterator[float]:
    """Press Body Parts: each body part has a color."""
    yield from _show_colors("PARTITIONS", folder)


def _show_colors(colors: str, folder: Path) -> Iterator[float]:
    across = {"ERRORS": 0.5, "PARTITIONS": 0.85}[colors]
    yield from sidebar.press_button(f"fdda.color_mesh(colors='{colors}')", across)
    yield from wait_until(
        lambda: extension_module("evaluation.heat_map").paint_kind(arm_object()) == colors,
        5,
        f"the button does not show {colors}",
    )
    with region_override("WINDOW"):
        bpy.ops.object.select_all(action="DESELECT")
    screenshot = folder / "colors.png"
    yield from save_screenshot(screenshot)
    ratio = colored_ratio(screenshot)
    screenshot.unlink()
    require(ratio > MIN_COLORED_RATIO, f"{100 * ratio:.2f} % of the viewport has a color")


def jump_to_the_worst_frame(folder: Path) -> Iterator[float]:
    """Jump to the worst frame, and show the errors of that frame only."""
    worst = extension_module("evaluation.last_evaluation").get(arm_object()).worst_poses(5)
    region3d = view_area().spaces[0].region_3d
    initial_location, initial_distance = region3d.view_location.copy(), region3d.view_distance
    yield from sidebar.press_button("fdda.jump_to_worst")
    yield 0.2
    frame = bpy.context.scene.frame_current
    require(frame == worst[0][0] + 1, f"it jumps to frame {frame}, the worst is {worst[0][0] + 1}")
    distance = region3d.view_distance
    require(distance == initial_distance, f"the button without the lens changes the view from {initial_distance}")
    yield from sidebar.press_button("zoom=True", across=0.98)
    yield from wait_until(
        lambda: region3d.view_distance < initial_distance,
        5,
        f"the view stays {initial_distance} away and does not go to the worst vertex",
    )
    yield from save_screenshot(folder / "worst_vertex.png")
    region3d.view_location, region3d.view_distance = initial_location, initial_distance
    view = bpy.context.window_manager.fdda_view
    yield from sidebar.press_button("fdda_view.statistic", across=0.85)
    yield from wait_until(lambda: view.statistic == "pose", 5, f"the button shows '{view.statistic}', not this frame")
    initial_range_mm = view.range_mm
    yield from sidebar.press_button("fdda.fit_color_range", across=0.98)
    yield from wait_until(
        lambda: view.range_mm > initial_range_mm, 5, f"the range of the colors is still {view.range_mm} mm"
    )
