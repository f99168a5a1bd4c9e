# SPDX-License-Identifier: GPL-3.0-or-later
"""Two stories: Blender is closed while it trains, and the next Blender follows the training to its end."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import bpy
import sidebar
from arm import (
    BLEND_FILE_NAME,
    arm_object,
    check_model_plays,
    extension_module,
    frame_object,
    make_empty_folder,
    wait_for_job,
)
from window import redraw_window, require, save_screenshot, wait_until

EPOCHS = 8000
"""Enough epochs that the training still runs when the next Blender has started."""


def _blend_file(folder: Path) -> Path:
    return folder / "work" / "left" / BLEND_FILE_NAME


def start_a_training(folder: Path) -> Iterator[float]:
    """Open a file that has a recording, and press Train."""
    folder_of_file = make_empty_folder(_blend_file(folder).parent)
    shutil.copytree(folder / "work" / "arm_recording", folder_of_file / "arm_recording")
    bpy.ops.wm.open_mainfile(filepath=str(folder / "work" / BLEND_FILE_NAME), load_ui=False)
    yield 1.0
    bpy.ops.fdda.unbind(object="arm")
    arm_object().fdda.models.clear()
    arm_object().fdda.settings.epochs = EPOCHS
    bpy.ops.wm.save_as_mainfile(filepath=str(_blend_file(folder)))
    frame_object(arm_object())
    yield from sidebar.open_tab()
    yield from sidebar.open_section("training")
    yield from sidebar.press_button("fdda.train")
    job = extension_module("jobs.job")
    yield from wait_until(lambda: job.current() is not None, 10, "the button starts no training")
    yield from wait_until(lambda: len(job.current().curves.get("training", ())) > 3, 90, "there are no epochs")


def close_blender_while_it_trains(folder: Path) -> Iterator[float]:
    """Check that the training still runs; then `drive` closes this Blender."""
    require(extension_module("jobs.job").current() is not None, "the training has ended already")
    require(not (_blend_file(folder).parent / "arm_model" / "arm.onnx").exists(), "there is a model already")
    yield 0.1


def open_the_file_in_a_new_blender(folder: Path) -> Iterator[float]:
    """Open the file: the section Training shows the running training, with its curve from the first epoch."""
    job = extension_module("jobs.job")
    bpy.ops.wm.open_mainfile(filepath=str(_blend_file(folder)), load_ui=False)
    yield from wait_until(lambda: job.current() is not None, 10, "the training is not followed")
    frame_object(arm_object())
    yield from sidebar.open_tab()
    yield from sidebar.open_section("training")
    yield from wait_until(lambda: len(job.current().curves.get("training", ())) > 3, 30, "its curves do not come back")
    require(job.state_of("train") is not None, "the section does not show it")
    yield from save_screenshot(folder / "followed.png")


def bind_the_trained_model(folder: Path) -> Iterator[float]:
    """Wait for the end of the training, and press Bind in the section Training."""
    yield from wait_for_job("train", 240)
    require((_blend_file(folder).parent / "arm_model" / "arm.onnx").exists(), "the training has written no model")
    require(
        len(extension_module("jobs.job").state_of("train").curves["training"]) == EPOCHS,
        "epochs are missing from the curve",
    )
    yield from redraw_window()
    yield from sidebar.press_button("fdda.bind")
    yield from wait_until(lambda: arm_object().fdda.is_bound, 20, "the trained model is not bound")
    check_model_plays()


STEPS_BEFORE_CLOSING = (start_a_training, close_blender_while_it_trains)
STEPS_AFTER_REOPENING = (open_the_file_in_a_new_blender, bind_the_trained_model)
