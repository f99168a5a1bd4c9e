# SPDX-License-Identifier: GPL-3.0-or-later
"""What a long session must not spoil: how fast the viewport plays beside the open tab, what was trained, and how the
model is set when it is baked. A function a step, with its checks."""

import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import bpy
import sidebar
from arm import arm, distance_mm, job_done, look_at, open_in, part, positions, shape
from window import (
    browsers,
    check,
    close_browser,
    picture,
    play,
    press,
    redraw,
    rest_mouse,
    stop,
    until,
)

EPOCHS, FRAMES, PLAY_SECONDS = 20, 40, 3
HALF = 0.5


def open_the_bound_file(folder: Path) -> Iterator[float]:
    """Open the file of the path, with its recording beside it."""
    own = folder / "work" / "session"
    yield from open_in(own, folder)
    shutil.copytree(folder / "work" / "arm_recording", own / "arm_recording")
    yield from sidebar.show()


def play_with_the_tab_open(folder: Path) -> Iterator[float]:
    """Play with the section Model open: no panel is drawn, for nothing of theirs changes."""
    yield from sidebar.open_section("playback")
    bpy.context.scene.frame_set(1)
    yield from rest_mouse()
    yield 1.0
    yield from play()
    sidebar.forget_drawn()
    end = time.monotonic() + PLAY_SECONDS
    while time.monotonic() < end:
        yield 0.1
    drawn = sidebar.drawn()
    yield from picture(folder / "playing.png")
    yield from stop()
    check(bpy.context.scene.frame_current != 1, "the action has not played")
    check(not drawn, f"while it plays the sections {sorted(drawn)} are drawn")


def adjust_what_has_trained(folder: Path) -> Iterator[float]:
    """Press Train, and F9 when it is done: nothing trains again, and the model is as it was written."""
    arm().fdda.settings.epochs = EPOCHS
    yield from sidebar.open_section("training")
    yield from sidebar.push("fdda.train")
    yield from job_done("train", 120)
    model = part("properties.character").model_file(arm())
    before, state = (model.read_bytes(), model.stat().st_mtime_ns), part("jobs.job").state_of("train")
    yield from rest_mouse()
    yield from press("F9")
    yield 0.5
    yield from picture(folder / "adjust_last_operation.png")
    yield from press("Return")
    yield 1.0
    yield from press("Escape")
    check(part("jobs.job").current() is None, "F9 and Return train again")
    check(part("jobs.job").state_of("train") is state, "it has trained again")
    check((model.read_bytes(), model.stat().st_mtime_ns) == before, "the model was written again")


def bake_half_the_strength(folder: Path) -> Iterator[float]:
    """Half the strength; press Bake… and Return in its dialog: the file that it names shows what the view showed."""
    full = shape()
    arm().fdda.strength = HALF
    shown = shape(FRAMES)
    check(distance_mm(shape(), full) > 0.1, "the strength changes nothing")
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = 1, FRAMES
    look_at(arm())
    yield from sidebar.open_section("playback")
    yield from sidebar.push("fdda.bake")
    yield from until(browsers, 5, "Bake… opens no file browser")
    yield from close_browser("Return")
    yield from job_done("bake", 60)
    yield from redraw()
    yield from picture(folder / "baked.png")
    baked = list((folder / "work" / "session").glob("*baked*.blend"))
    check(len(baked) == 1, f"baked is {[path.name for path in baked]}")
    bpy.ops.wm.open_mainfile(filepath=str(baked[0]), load_ui=False)
    yield 1.0
    check(not arm().fdda.is_bound, "what was baked still plays a model")
    bpy.context.scene.frame_set(FRAMES)
    apart = distance_mm(positions(arm()), shown)
    check(apart < 1e-3, f"what was baked is {apart:.3f} mm from what was shown")
    look_at(arm())


STEPS = (open_the_bound_file, play_with_the_tab_open, adjust_what_has_trained, bake_half_the_strength)
