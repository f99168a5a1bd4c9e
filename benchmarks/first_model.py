# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure how long a first model takes in the window: `blender --python benchmarks/first_model.py -- RIG.blend OUT`.

Follows the manual with the mouse, from opening the user's file to playing the model: the section Rig, Human Ranges if
the rig has no limits, Record, Train, Bind, the space bar. Needs a window, xdotool and imagemagick, and the installed
extension with a Python that trains, as `make test-gui` does. Presses each button as soon as it is enabled; a person
also needs time to read. Writes pictures and OUT/times.json, and quits Blender.
"""

import json
import os
import shutil
import sys
import time
import traceback
from collections.abc import Iterator
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "gui"))

import sidebar
from arm import extension_module, wait_for_job
from window import (
    main_screen,
    park_mouse,
    press_keys,
    region_override,
    require,
    save_screenshot,
    wait_until,
)

RIG, OUT = (Path(argument).resolve() for argument in sys.argv[sys.argv.index("--") + 1 :][:2])
TIME_LIMIT_S = 300
"""Time limit from opening the file to playing, seconds."""

step_times: dict[str, float] = {}


def find_character() -> bpy.types.Object:
    """Return the mesh object with the most vertices that an armature deforms."""
    rigged = [
        o for o in bpy.context.scene.objects if o.type == "MESH" and any(m.type == "ARMATURE" for m in o.modifiers)
    ]
    return max(rigged, key=lambda o: len(o.data.vertices))


def select_character() -> None:
    """Select the character alone, and show it."""
    with region_override("WINDOW"):
        bpy.ops.object.select_all(action="DESELECT")
        find_character().select_set(True)
        bpy.context.view_layer.objects.active = find_character()
        bpy.ops.view3d.view_selected()


def check_trainer() -> Iterator[float]:
    """Press the button that checks the trainer, unless it was checked; yield the seconds to wait."""
    session = extension_module("training.environment.session")
    if session.check_result is None:
        yield from sidebar.press_button("fdda.check_trainer", across=0.2)
        yield from wait_until(lambda: session.check_result is not None, 60, "the check of the trainer does not end")
    yield 0.3


def make_first_model() -> Iterator[float]:
    """Go from opening the file to playing the model; yield the seconds to wait."""
    user_file = OUT / RIG.name
    OUT.mkdir(parents=True, exist_ok=True)
    shutil.copy(RIG, user_file)
    user_file.chmod(0o644)
    start_time = time.monotonic()

    def note_time(step: str) -> None:
        step_times[step] = round(time.monotonic() - start_time, 1)
        print(f"{step_times[step]:6.1f} s  {step}", flush=True)

    bpy.ops.wm.open_mainfile(filepath=str(user_file), load_ui=False)
    yield 1.0
    select_character()
    yield from sidebar.open_tab()
    yield 1.0
    yield from sidebar.open_section("rig")
    yield from save_screenshot(OUT / "1_rig.png")
    note_time("opened, rig read")
    yield from sidebar.open_section("poses")
    yield from save_screenshot(OUT / "2_poses.png")
    if not extension_module("panels.poses").has_any_limits(
        extension_module("scene.active_rig").cached_active_rig(bpy.context)
    ):
        yield from sidebar.press_button("fdda.human_limits(")
        yield 0.5
    yield from sidebar.press_button("fdda.preview_pose", across=0.45)
    yield 0.5
    yield from save_screenshot(OUT / "3_pose.png")
    yield from sidebar.press_button("fdda.rest_pose", across=0.85)
    note_time("ranges set, a pose previewed")
    yield from sidebar.open_section("recording")
    yield from sidebar.press_button("fdda.record(")
    yield from wait_for_job("record", TIME_LIMIT_S)
    yield from save_screenshot(OUT / "4_recorded.png")
    note_time("recorded")
    yield from sidebar.open_section("training")
    yield from check_trainer()
    yield from sidebar.press_button("fdda.train(")
    yield from wait_for_job("train", TIME_LIMIT_S)
    yield from save_screenshot(OUT / "5_trained.png")
    note_time("trained")
    yield from sidebar.open_section("playback")
    yield from sidebar.press_button("fdda.bind(")
    yield from wait_until(lambda: find_character().fdda.is_bound, 20, "the button does not bind the character")
    require(not find_character().fdda.status, find_character().fdda.status)
    note_time("bound")
    yield from park_mouse()
    yield from press_keys("space")
    yield from wait_until(lambda: main_screen().is_animation_playing, 5, "the space bar does not start playback")
    note_time("playing")
    yield 2.0
    yield from save_screenshot(OUT / "6_playing.png")
    yield from press_keys("space")
    require(find_character().fdda.mode == "FDDA" and not find_character().fdda.status, find_character().fdda.status)
    (OUT / "times.json").write_text(json.dumps(step_times, indent=1))
    require(step_times["playing"] < TIME_LIMIT_S, f"the first model took {step_times['playing']:.0f} s")


def tick(steps: Iterator[float] = make_first_model()) -> float | None:  # noqa: B008
    """Run the next step, as a timer of Blender."""
    try:
        return next(steps)
    except StopIteration:
        bpy.ops.wm.quit_blender()
    except Exception:  # Blender would print the error and stay open.
        traceback.print_exc()
        for _ in save_screenshot(OUT / "failed.png"):
            pass
        sys.stdout.flush()
        os._exit(1)
    return None


bpy.context.preferences.view.show_splash = False
bpy.app.timers.register(tick, first_interval=1.0, persistent=True)
