# SPDX-License-Identifier: GPL-3.0-or-later
"""Story: playback with the sidebar open, Adjust Last Operation after a training, baking. Each function is a step."""

import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import bpy
import sidebar
from arm import (
    arm_object,
    arm_positions,
    evaluated_positions,
    extension_module,
    frame_object,
    mean_distance_mm,
    open_copy_in,
    wait_for_job,
)
from window import (
    close_browser,
    file_browser_count,
    park_mouse,
    press_keys,
    redraw_window,
    require,
    save_screenshot,
    start_playback,
    stop_playback,
    wait_until,
)

EPOCHS, FRAMES, PLAY_SECONDS = 20, 40, 3
HALF_STRENGTH = 0.5


def open_the_bound_file(folder: Path) -> Iterator[float]:
    """Open a copy of the file with the bound model, with a copy of its recording next to it."""
    folder_of_file = folder / "work" / "session"
    yield from open_copy_in(folder_of_file, folder)
    shutil.copytree(folder / "work" / "arm_recording", folder_of_file / "arm_recording")
    yield from sidebar.open_tab()


def play_with_the_tab_open(folder: Path) -> Iterator[float]:
    """Play with the section Model open: no section is redrawn, because none changes."""
    yield from sidebar.open_section("playback")
    bpy.context.scene.frame_set(1)
    yield from park_mouse()
    yield 1.0
    yield from start_playback()
    sidebar.clear_drawn_sections()
    end_time = time.monotonic() + PLAY_SECONDS
    while time.monotonic() < end_time:
        yield 0.1
    names = sidebar.drawn_sections()
    yield from save_screenshot(folder / "playing.png")
    yield from stop_playback()
    require(bpy.context.scene.frame_current != 1, "the action has not played")
    require(not names, f"while it plays the sections {sorted(names)} are drawn")


def adjust_last_operation_after_training(folder: Path) -> Iterator[float]:
    """Press Train, and F9 after its end: nothing is trained again, and the model file is unchanged."""
    arm_object().fdda.settings.passes = EPOCHS
    yield from sidebar.open_section("training")
    yield from sidebar.press_button("fdda.train")
    yield from wait_for_job("train", 120)
    model = extension_module("properties.character").model_file(arm_object())
    before, state = (model.read_bytes(), model.stat().st_mtime_ns), extension_module("jobs.job").state_of("train")
    yield from park_mouse()
    yield from press_keys("F9")
    yield 0.5
    yield from save_screenshot(folder / "adjust_last_operation.png")
    yield from press_keys("Return")
    yield 1.0
    yield from press_keys("Escape")
    require(extension_module("jobs.job").current() is None, "F9 and Return train again")
    require(extension_module("jobs.job").state_of("train") is state, "it has trained again")
    require((model.read_bytes(), model.stat().st_mtime_ns) == before, "the model was written again")


def bake_half_the_strength(folder: Path) -> Iterator[float]:
    """Bake at half the strength: the baked file shows the same shape as the viewport did."""
    positions_at_full_strength = arm_positions()
    arm_object().fdda.strength = HALF_STRENGTH
    positions_at_half_strength = arm_positions(FRAMES)
    require(mean_distance_mm(arm_positions(), positions_at_full_strength) > 0.1, "the strength changes nothing")
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = 1, FRAMES
    frame_object(arm_object())
    yield from sidebar.open_section("playback")
    yield from sidebar.press_button("fdda.bake(")
    yield from wait_until(file_browser_count, 5, "Bake… opens no file browser")
    yield from close_browser("Return")
    if not bpy.app.build_options.alembic:
        # Blender of a distribution.
        state_of = extension_module("jobs.job").state_of
        is_done = lambda: state_of("bake") is not None and not state_of("bake").is_running  # noqa: E731
        yield from wait_until(is_done, 60, "the job bake does not end")
        require("built without Alembic" in state_of("bake").outcome, state_of("bake").outcome)
        return
    yield from wait_for_job("bake", 60)
    yield from redraw_window()
    yield from save_screenshot(folder / "baked.png")
    baked_files = list((folder / "work" / "session").glob("*baked*.blend"))
    require(len(baked_files) == 1, f"the baked files are {[path.name for path in baked_files]}")
    bpy.ops.wm.open_mainfile(filepath=str(baked_files[0]), load_ui=False)
    yield 1.0
    require(not arm_object().fdda.is_bound, "the baked file still plays a model")
    bpy.context.scene.frame_set(FRAMES)
    distance = mean_distance_mm(evaluated_positions(arm_object()), positions_at_half_strength)
    require(distance < 1e-3, f"the baked shape is {distance:.3f} mm from the shown shape")
    frame_object(arm_object())


STEPS = (open_the_bound_file, play_with_the_tab_open, adjust_last_operation_after_training, bake_half_the_strength)
