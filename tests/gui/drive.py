# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs a story in a Blender with a window. `run.py` calls `blender --python tests/gui/drive.py -- FOLDER STORY`.

Each step has checks, and a screenshot of its end is written to the folder. A step that fails prints the reason and ends
Blender with status 1.
"""

import faulthandler
import json
import os
import sys
import time
import traceback
from collections.abc import Iterator
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))
sys.path.append(str(Path(__file__).resolve().parents[2]))

import choices_story
import manual_story
import path_story
import session_story
import shot_story
import work_story
from window import StepError, park_mouse, save_screenshot

OUTPUT_FOLDER, STORY_NAME = Path(sys.argv[sys.argv.index("--") + 1]).resolve(), sys.argv[sys.argv.index("--") + 2]
STEPS = {
    "path": path_story.STEPS,
    "choices": choices_story.STEPS,
    "work": work_story.STEPS,
    "shot": shot_story.STEPS,
    "session": session_story.STEPS,
    "manual": manual_story.STEPS,
}[STORY_NAME]
MAX_SECONDS = 1790
"""Time limit of the whole story. A Blender that exceeds it is killed and prints where it was."""

step_records: list[dict] = []
current_step = "starting"


def run_steps() -> Iterator[float]:
    """Run all steps; yield the seconds to wait."""
    global current_step
    for index, step in enumerate(STEPS, 1):
        current_step, start = step.__name__.replace("_", " "), time.monotonic()
        yield from step(OUTPUT_FOLDER)
        screenshot_name = f"{index:02}_{step.__name__}.png"
        yield from park_mouse()
        yield from save_screenshot(OUTPUT_FOLDER / screenshot_name)
        record_step(
            {"step": current_step, "seconds": time.monotonic() - start, "picture": screenshot_name, "of": len(STEPS)}
        )


def record_step(step_record: dict) -> None:
    """Append a finished step to the file that `run.py` reads."""
    step_records.append(step_record)
    (OUTPUT_FOLDER / "steps.json").write_text(json.dumps(step_records, indent=1), encoding="utf-8")
    print(f"{step_record['step']}: {step_record['seconds']:.1f} s", flush=True)


def fail() -> None:
    """Write a screenshot of the failure, and end Blender with status 1."""
    for _ in save_screenshot(OUTPUT_FOLDER / "failed.png"):
        pass
    end_blender(1)


def end_blender(status: int) -> None:
    """End Blender. Without an error its own operator ends it, which tests that it disables the add-on."""
    sys.stdout.flush()
    sys.stderr.flush()
    if status:
        os._exit(status)
    bpy.ops.wm.quit_blender()


def run_next_part(parts: Iterator[float] = run_steps()) -> float | None:  # noqa: B008
    """Run the story up to its next wait, and return the seconds to wait. Called by a timer."""
    try:
        return next(parts)
    except StopIteration:
        end_blender(0)
    except StepError as error:
        print(f"Step '{current_step}' failed: {error}", file=sys.stderr, flush=True)
        fail()
    except Exception:  # Otherwise Blender would print it and stay open.
        traceback.print_exc()
        print(f"Step '{current_step}' raised an exception (see above).", file=sys.stderr, flush=True)
        fail()
    return None


# A Python thread would wait forever if Blender hangs and keeps the GIL.
faulthandler.dump_traceback_later(MAX_SECONDS, exit=True)
bpy.context.preferences.view.show_splash = False
# Without a window manager a second window would cover the first.
bpy.context.preferences.view.filebrowser_display_type = "SCREEN"
bpy.app.timers.register(run_next_part, first_interval=1.0, persistent=True)
