# SPDX-License-Identifier: GPL-3.0-or-later
"""Story: the arm learns from a copy of itself with a soft body simulation. Each function is a step."""

import time
from collections.abc import Iterator
from pathlib import Path

import bpy
import sidebar
from arm import (
    BLEND_FILE_NAME,
    arm_object,
    arm_positions,
    check_model_plays,
    evaluated_positions,
    extension_module,
    frame_object,
    make_empty_folder,
    mean_distance_mm,
    wait_for_job,
)
from window import (
    click,
    park_mouse,
    press_keys,
    redraw_window,
    require,
    save_screenshot,
    start_playback,
    stop_playback,
    wait_until,
)

from blend_fixtures.flesh import FLESH, add_flesh, make_soft_body

POSES, MAX_SETTLE_FRAMES, COMPARED_POSES, EPOCHS = 24, 60, 3, 60
"""Few poses, because settling takes seconds; enough to be more accurate than linear skinning."""
SOFT_BONES, PLAY_SECONDS = ("shoulder", "elbow"), 3


def add_a_soft_body_copy(folder: Path) -> Iterator[float]:
    """Add the sample arm, and a copy of it with a soft body simulation."""
    bpy.ops.wm.read_homefile(app_template="", load_ui=False)
    yield 0.5
    bpy.data.objects.remove(bpy.data.objects["Cube"])
    bpy.ops.fdda.add_sample_arm(density="1")
    make_soft_body(add_flesh(arm_object()), SOFT_BONES)
    # The arm and its copy overlap.
    arm_object().display_type = "WIRE"
    bpy.ops.wm.save_as_mainfile(filepath=str(make_empty_folder(folder / "flesh") / BLEND_FILE_NAME))
    frame_object(arm_object())
    yield from sidebar.open_tab()


def choose_the_soft_body_as_target(folder: Path) -> Iterator[float]:
    """Enter the name of the copy under Learn from Object, and the number of frames under Settle."""
    settings = arm_object().fdda.settings
    settings.poses, settings.epochs = POSES, EPOCHS
    yield from sidebar.open_section("recording")
    yield from sidebar.open_subpanel("fdda.record", "settings.target", across=0.7)
    yield from sidebar.type_into_search_field("settings.target", FLESH)
    yield from press_keys("Return")
    yield from wait_until(lambda: settings.target == FLESH, 5, f"the field has '{settings.target}'")
    x, y = yield from sidebar.find_button("settings.max_settle_frames", across=0.7)
    yield from click(x, y, times=2)
    yield 0.3
    yield from press_keys("ctrl+a", *str(MAX_SETTLE_FRAMES), "Return")
    yield from wait_until(
        lambda: settings.max_settle_frames == MAX_SETTLE_FRAMES, 5, f"the field has {settings.max_settle_frames} frames"
    )
    yield from redraw_window()
    yield from save_screenshot(folder / "target.png")


def record_settled_poses(folder: Path) -> Iterator[float]:
    """Press Record: each pose is held until the simulation is at rest."""
    job = extension_module("jobs.job")
    yield from sidebar.press_button("fdda.record")
    yield from wait_until(lambda: job.state_of("record") and job.state_of("record").done > 1, 90, "nothing is recorded")
    yield from save_screenshot(folder / "settling.png")
    yield from wait_for_job("record", 400)
    index = extension_module("core.recording.index").read_index(folder / "flesh" / "arm_recording")
    require(index["complete"] == POSES and index["repeatability"]["poses"], f"recorded is {index['complete']}")
    yield from redraw_window()
    yield from save_screenshot(folder / "flesh_recorded.png")
    require(len(index.get("unsettled", ())) < POSES // 2, f"{index.get('unsettled')} did not settle")


def train_and_bind(folder: Path) -> Iterator[float]:
    """Press Train, then Bind: the model plays."""
    yield from sidebar.open_section("training")
    yield from sidebar.press_button("fdda.train")
    yield from wait_for_job("train", 120)
    yield from sidebar.open_section("playback")
    yield from sidebar.press_button("fdda.bind")
    yield from wait_until(lambda: arm_object().fdda.is_bound, 20, "the button binds nothing")
    check_model_plays()


def evaluate_against_the_soft_body(folder: Path) -> Iterator[float]:
    """Press Evaluate: the model is closer to the simulation than linear skinning is."""
    view = bpy.context.window_manager.fdda_view
    view.source, view.poses = "RANDOM", COMPARED_POSES
    evaluations = extension_module("evaluation.last_evaluation")
    yield from sidebar.open_section("evaluation")
    yield from sidebar.press_button("fdda.evaluate")
    yield from wait_until(lambda: evaluations.get(arm_object()) is not None, 120, "nothing is evaluated")
    total = evaluations.get(arm_object()).total
    require(0 < total["fdda"].mean < total["linear"].mean, f"the model is no closer than linear skinning: {total}")


def play_without_the_soft_body(folder: Path) -> Iterator[float]:
    """Remove the simulated copy and play the action: the model does not need it."""
    bpy.data.objects.remove(bpy.data.objects[FLESH])
    arm_object().display_type = "TEXTURED"
    yield from sidebar.open_section("playback")
    before = arm_positions()
    bpy.context.scene.frame_set(1)
    yield from start_playback()
    end = time.monotonic() + PLAY_SECONDS
    while time.monotonic() < end:
        yield 0.1
    yield from stop_playback()
    check_model_plays()
    require(mean_distance_mm(evaluated_positions(arm_object()), before) > 1, "the arm does not move")
    yield from park_mouse()
    yield from save_screenshot(folder / "flesh_plays.png")


STEPS = (
    add_a_soft_body_copy,
    choose_the_soft_body_as_target,
    record_settled_poses,
    train_and_bind,
    evaluate_against_the_soft_body,
    play_without_the_soft_body,
)
