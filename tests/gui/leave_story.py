# SPDX-License-Identifier: GPL-3.0-or-later
"""A Blender that is closed while it trains, and the next one, in which the training is followed to its end."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import bpy
import sidebar
from arm import BLEND, arm, check_it_plays, emptied, job_done, look_at, part
from window import check, picture, redraw, until

EPOCHS = 8000
"""So many that the training outlasts the start of a Blender."""


def _file(folder: Path) -> Path:
    return folder / "work" / "left" / BLEND


def start_a_training(folder: Path) -> Iterator[float]:
    """A file with a recording; press Train."""
    own = emptied(_file(folder).parent)
    shutil.copytree(folder / "work" / "arm_recording", own / "arm_recording")
    bpy.ops.wm.open_mainfile(filepath=str(folder / "work" / BLEND), load_ui=False)
    yield 1.0
    bpy.ops.fdda.unbind(object="arm")
    arm().fdda.models.clear()
    arm().fdda.settings.epochs = EPOCHS
    bpy.ops.wm.save_as_mainfile(filepath=str(_file(folder)))
    look_at(arm())
    yield from sidebar.show()
    yield from sidebar.open_section("training")
    yield from sidebar.push("fdda.train")
    job = part("jobs.job")
    yield from until(lambda: job.current() is not None, 10, "the button starts no training")
    yield from until(lambda: len(job.current().curves.get("training", ())) > 3, 90, "there are no epochs")


def close_blender(folder: Path) -> Iterator[float]:
    """It still trains; this Blender is closed now, by its own operator."""
    check(part("jobs.job").current() is not None, "the training has ended already")
    check(not (_file(folder).parent / "arm_model" / "arm.onnx").exists(), "there is a model already")
    yield 0.1


def open_the_file_in_a_new_blender(folder: Path) -> Iterator[float]:
    """The training has gone on, and is followed: its section shows it, with the curve from the beginning."""
    job = part("jobs.job")
    bpy.ops.wm.open_mainfile(filepath=str(_file(folder)), load_ui=False)
    yield from until(lambda: job.current() is not None, 10, "the training is not followed")
    look_at(arm())
    yield from sidebar.show()
    yield from sidebar.open_section("training")
    yield from until(lambda: len(job.current().curves.get("training", ())) > 3, 30, "its curves do not come back")
    check(job.state_of("train") is not None, "the section does not show it")
    yield from picture(folder / "followed.png")


def bind_what_was_trained(folder: Path) -> Iterator[float]:
    """It ends, and is bound with the button of the section Training."""
    yield from job_done("train", 240)
    check((_file(folder).parent / "arm_model" / "arm.onnx").exists(), "the training has written no model")
    check(len(part("jobs.job").state_of("train").curves["training"]) == EPOCHS, "epochs are missing from the curve")
    yield from redraw()
    yield from sidebar.push("fdda.bind")
    yield from until(lambda: arm().fdda.is_bound, 20, "the trained model is not bound")
    check_it_plays()


LEAVE = (start_a_training, close_blender)
BACK = (open_the_file_in_a_new_blender, bind_what_was_trained)
