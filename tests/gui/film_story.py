# SPDX-License-Identifier: GPL-3.0-or-later
"""Story: compare the bound arm with its rig, cancel a film of its action, and render it. Each function is a step."""

from collections.abc import Iterator
from pathlib import Path

import bpy
import evaluation_steps
import sidebar
from arm import BENT_FRAME, arm_object, armature_object, check_model_plays, extension_module, frame_object
from window import (
    close_browser,
    file_browser_count,
    park_mouse,
    press_keys,
    require,
    save_screenshot,
    wait_until,
)

FILM_FRAMES, BROWSER_SECONDS, FILM_SECONDS = 12, 5, 180


def open_the_bound_arm(folder: Path) -> Iterator[float]:
    bpy.ops.wm.open_mainfile(filepath=str(folder / "work" / "arm.blend"), load_ui=False)
    yield 1.0
    check_model_plays()
    frame_object(arm_object())
    yield from sidebar.open_tab()


def _files(folder: Path) -> list[str]:
    """Return the names of the films, and of temporary files, beside the .blend file."""
    return [path.name for path in (folder / "work").iterdir() if path.suffix == ".mp4" or ".fdda" in path.name]


def _press_render_comparison(folder: Path) -> Iterator[float]:
    yield from sidebar.press_button("fdda.render_comparison")
    yield from wait_until(file_browser_count, BROWSER_SECONDS, "the button opens no file browser")
    yield 0.5
    yield from save_screenshot(folder / "film_browser.png")
    yield from close_browser("Return")


def cancel_a_film(folder: Path) -> Iterator[float]:
    action = armature_object().animation_data.action
    action.use_frame_range, action.frame_start, action.frame_end = True, BENT_FRAME, BENT_FRAME + FILM_FRAMES - 1
    yield from _cancel(folder, "film")


def cancel_the_encoding(folder: Path) -> Iterator[float]:
    yield from _cancel(folder, "encoding")


def _cancel(folder: Path, stage: str) -> Iterator[float]:
    """Press ESC in a stage of a film, and check that nothing is left."""
    job = extension_module("jobs.job")
    yield from _press_render_comparison(folder)

    def is_in_stage() -> bool:
        state = job.state_of("render_comparison")
        return (
            state is not None and state.is_running and state.stage == stage and (stage == "encoding" or state.done > 1)
        )

    yield from park_mouse()
    yield from wait_until(is_in_stage, FILM_SECONDS, f"the job does not reach the stage '{stage}'")
    yield from press_keys("Escape")
    yield from wait_until(lambda: job.current() is None, FILM_SECONDS, "ESC does not cancel the film")
    state = job.state_of("render_comparison")
    require(state.outcome_level == "WARNING", f"the film ended with '{state.outcome}'")
    require(not _files(folder), f"the canceled film has left {_files(folder)}")
    check_model_plays()


def render_a_film(folder: Path) -> Iterator[float]:
    job = extension_module("jobs.job")
    yield from _press_render_comparison(folder)
    yield from wait_until(lambda: job.current() is not None, BROWSER_SECONDS, "the button starts no job")
    yield from wait_until(lambda: job.current() is None, FILM_SECONDS, "the film does not end")
    state = job.state_of("render_comparison")
    require(state.outcome == f"Rendered {FILM_FRAMES} frames to {_files(folder)[0]}.", f"it reports '{state.outcome}'")
    require(len(_files(folder)) == 1, f"the film has left {_files(folder)}")
    check_model_plays()


STEPS = (
    open_the_bound_arm,
    evaluation_steps.evaluate,
    evaluation_steps.show_the_heat_map,
    evaluation_steps.mark_the_worst_frames,
    cancel_a_film,
    cancel_the_encoding,
    render_a_film,
)
