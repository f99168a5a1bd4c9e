# SPDX-License-Identifier: GPL-3.0-or-later
"""Learning a simulation: the arm learns from a copy of it that is a soft body. A function a step, with its checks."""

import time
from collections.abc import Iterator
from pathlib import Path

import bpy
import sidebar
from arm import BLEND, arm, check_it_plays, distance_mm, emptied, job_done, look_at, part, positions, shape
from window import check, click, picture, play, press, redraw, rest_mouse, stop, until

from blend_fixtures.flesh import FLESH, add_flesh, make_soft_body

POSES, SETTLE, COMPARED, EPOCHS = 24, 60, 3, 60
"""Few poses, as settling takes seconds: enough to be better than nothing."""
FLESHY, PLAY_SECONDS = ("shoulder", "elbow"), 3


def give_the_arm_flesh(folder: Path) -> Iterator[float]:
    """The sample arm, and a copy of it that is a soft body."""
    bpy.ops.wm.read_homefile(app_template="", load_ui=False)
    yield 0.5
    bpy.data.objects.remove(bpy.data.objects["Cube"])
    bpy.ops.fdda.add_sample_arm(density="1")
    make_soft_body(add_flesh(arm()), FLESHY)
    # Both are in one place.
    arm().display_type = "WIRE"
    bpy.ops.wm.save_as_mainfile(filepath=str(emptied(folder / "flesh") / BLEND))
    look_at(arm())
    yield from sidebar.show()


def choose_the_target(folder: Path) -> Iterator[float]:
    """Click the field Learn from Object, type the name of the copy; how long poses are held is set below it."""
    settings = arm().fdda.settings
    settings.poses, settings.epochs = POSES, EPOCHS
    yield from sidebar.open_section("recording")
    yield from sidebar.type_into("settings.target", FLESH)
    yield from press("Return")
    yield from until(lambda: settings.target == FLESH, 5, f"the field has '{settings.target}'")
    x, y = yield from sidebar.find("settings.max_settle_frames", across=0.7)
    yield from click(x, y, times=2)
    yield 0.3
    yield from press("ctrl+a", *str(SETTLE), "Return")
    yield from until(
        lambda: settings.max_settle_frames == SETTLE, 5, f"the field has {settings.max_settle_frames} frames"
    )
    yield from redraw()
    yield from picture(folder / "target.png")


def record_settled_poses(folder: Path) -> Iterator[float]:
    """Press Record: each pose is held until the flesh has come to rest."""
    job = part("jobs.job")
    yield from sidebar.push("fdda.record")
    yield from until(lambda: job.state_of("record") and job.state_of("record").done > 1, 90, "nothing is recorded")
    yield from picture(folder / "settling.png")
    yield from job_done("record", 400)
    index = part("core.recording.index").read_index(folder / "flesh" / "arm_recording")
    check(index["complete"] == POSES and index["repeatability"]["poses"], f"recorded is {index['complete']}")
    yield from redraw()
    yield from picture(folder / "flesh_recorded.png")
    check(len(index.get("unsettled", ())) < POSES // 2, f"{index.get('unsettled')} have not come to rest")


def train_and_bind(folder: Path) -> Iterator[float]:
    """Press Train, and Bind: the arm has the flesh of its pose."""
    yield from sidebar.open_section("training")
    yield from sidebar.push("fdda.train")
    yield from job_done("train", 120)
    yield from sidebar.open_section("playback")
    yield from sidebar.push("fdda.bind")
    yield from until(lambda: arm().fdda.is_bound, 20, "the button binds nothing")
    check_it_plays()


def evaluate_against_the_flesh(folder: Path) -> Iterator[float]:
    """Press Evaluate: random poses, compared with the flesh."""
    view = bpy.context.window_manager.fdda_view
    view.source, view.poses = "RANDOM", COMPARED
    evaluations = part("evaluation.last_evaluation")
    yield from sidebar.open_section("evaluation")
    yield from sidebar.push("fdda.evaluate")
    yield from until(lambda: evaluations.get(arm()) is not None, 120, "nothing is evaluated")
    total = evaluations.get(arm()).total
    check(0 < total["fdda"].mean < total["linear"].mean, f"the model is no closer than linear skinning: {total}")


def play_without_the_flesh(folder: Path) -> Iterator[float]:
    """Remove the flesh, and play: the arm needs it no more."""
    bpy.data.objects.remove(bpy.data.objects[FLESH])
    arm().display_type = "TEXTURED"
    yield from sidebar.open_section("playback")
    before = shape()
    bpy.context.scene.frame_set(1)
    yield from play()
    end = time.monotonic() + PLAY_SECONDS
    while time.monotonic() < end:
        yield 0.1
    yield from stop()
    check_it_plays()
    check(distance_mm(positions(arm()), before) > 1, "the arm does not move")
    yield from rest_mouse()
    yield from picture(folder / "flesh_plays.png")


STEPS = (
    give_the_arm_flesh,
    choose_the_target,
    record_settled_poses,
    train_and_bind,
    evaluate_against_the_flesh,
    play_without_the_flesh,
)
