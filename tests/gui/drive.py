# SPDX-License-Identifier: GPL-3.0-or-later
"""Goes the whole path in a Blender with a window: `blender --python tests/gui/drive.py -- FOLDER STORY`, by run.py.

Each step has its checks and leaves a picture in the folder. A step that fails says why and ends Blender with status 1.
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

import cast_story
import endure_story
import flesh_story
import leave_story
import path_story
import ranges_story
import session_story
import shot_story
import work_story
from window import StepError, picture, rest_mouse

FOLDER, NAME = Path(sys.argv[sys.argv.index("--") + 1]).resolve(), sys.argv[sys.argv.index("--") + 2]
STEPS = {
    "path": path_story.STEPS,
    "work": work_story.STEPS,
    "shot": shot_story.STEPS,
    "cast": cast_story.STEPS,
    "ranges": ranges_story.STEPS,
    "flesh": flesh_story.STEPS,
    "session": session_story.STEPS,
    "endure": endure_story.STEPS,
    "leave": leave_story.LEAVE,
    "back": leave_story.BACK,
}[NAME]
WATCH_SECONDS = 590
"""All of it: a Blender that hangs is ended, and says where."""

done: list[dict] = []
under_way = "starting"


def steps() -> Iterator[float]:
    """Take all steps; seconds to wait."""
    global under_way
    for number, step in enumerate(STEPS, 1):
        under_way, began = step.__name__.replace("_", " "), time.monotonic()
        yield from step(FOLDER)
        shown = f"{number:02}_{step.__name__}.png"
        yield from rest_mouse()
        yield from picture(FOLDER / shown)
        note({"step": under_way, "seconds": time.monotonic() - began, "picture": shown, "of": len(STEPS)})


def note(entry: dict) -> None:
    """Keep what was done where run.py reads it."""
    done.append(entry)
    (FOLDER / "steps.json").write_text(json.dumps(done, indent=1), encoding="utf-8")
    print(f"{entry['step']}: {entry['seconds']:.1f} s", flush=True)


def give_up() -> None:
    """Leave a picture of what went wrong, and end Blender: it has no way to end with a status."""
    for _ in picture(FOLDER / "failed.png"):
        pass
    finish(1)


def finish(status: int) -> None:
    """End Blender. Closed by its operator, it disables its add-ons before: a part of what is tested."""
    sys.stdout.flush()
    sys.stderr.flush()
    if status:
        os._exit(status)
    bpy.ops.wm.quit_blender()


def tick(path: Iterator[float] = steps()) -> float | None:  # noqa: B008
    """The timer: one piece of the path."""
    try:
        return next(path)
    except StopIteration:
        finish(0)
    except StepError as error:
        print(f"Step '{under_way}' failed: {error}", file=sys.stderr, flush=True)
        give_up()
    except Exception:  # Blender would print it and stay open.
        traceback.print_exc()
        print(f"Step '{under_way}' broke off (see above).", file=sys.stderr, flush=True)
        give_up()
    return None


# Not a thread of Python: it would wait for ever where Blender does not let go of the interpreter.
faulthandler.dump_traceback_later(WATCH_SECONDS, exit=True)
bpy.context.preferences.view.show_splash = False
# Without a window manager another window would lie over the first.
bpy.context.preferences.view.filebrowser_display_type = "SCREEN"
bpy.app.timers.register(tick, first_interval=1.0, persistent=True)
