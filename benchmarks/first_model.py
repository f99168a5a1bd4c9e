# SPDX-License-Identifier: GPL-3.0-or-later
"""How long a first model takes in the window: `blender --python benchmarks/first_model.py -- RIG.blend OUT`.

Goes the way of the manual with the mouse, from opening a file of the user's own to a model that plays: the section Rig,
Human Ranges where the rig states none, Record, Train, Bind, the space bar. Needs a window, xdotool and imagemagick,
and the installed extension with a Python that trains, as `make test-gui` does. Buttons are pressed as soon as they may
be: a person adds the reading. Writes pictures and times.json into OUT, and ends Blender.
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
from path_story import job_done, main_screen, part
from window import check, over, picture, press, rest_mouse, until

RIG, OUT = (Path(argument).resolve() for argument in sys.argv[sys.argv.index("--") + 1 :][:2])
LIMIT = 300
"""Seconds that it may take."""

times: dict[str, float] = {}


def character() -> bpy.types.Object:
    """The mesh: the one with the most vertices that an armature deforms."""
    rigged = [
        o for o in bpy.context.scene.objects if o.type == "MESH" and any(m.type == "ARMATURE" for m in o.modifiers)
    ]
    return max(rigged, key=lambda o: len(o.data.vertices))


def way() -> Iterator[float]:
    """From the file to playing; seconds to wait."""
    own = OUT / RIG.name
    OUT.mkdir(parents=True, exist_ok=True)
    shutil.copy(RIG, own)
    own.chmod(0o644)
    began = time.monotonic()

    def done(step: str) -> None:
        times[step] = round(time.monotonic() - began, 1)
        print(f"{times[step]:6.1f} s  {step}", flush=True)

    bpy.ops.wm.open_mainfile(filepath=str(own), load_ui=False)
    yield 1.0
    with over("WINDOW"):
        bpy.ops.object.select_all(action="DESELECT")
        character().select_set(True)
        bpy.context.view_layer.objects.active = character()
        bpy.ops.view3d.view_selected()
    yield from sidebar.show()
    yield 1.0
    yield from sidebar.open_section("rig")
    yield from picture(OUT / "1_rig.png")
    done("opened, Rig read")
    yield from sidebar.open_section("poses")
    yield from picture(OUT / "2_poses.png")
    if not part("panels.poses").has_any_limits(part("scene.active_rig").cached_active_rig(bpy.context)):
        yield from sidebar.push("fdda.human_limits(")
        yield 0.5
    yield from sidebar.push("fdda.preview_pose", across=0.45)
    yield 0.5
    yield from picture(OUT / "3_pose.png")
    yield from sidebar.push("fdda.rest_pose", across=0.85)
    done("ranges, a pose looked at")
    yield from sidebar.open_section("recording")
    yield from sidebar.push("fdda.record(")
    yield from job_done("record", LIMIT)
    yield from picture(OUT / "4_recorded.png")
    done("recorded")
    yield from sidebar.open_section("training")
    session = part("training.environment.session")
    if session.check_result is None:
        yield from sidebar.push("fdda.check_trainer", across=0.2)
        yield from until(lambda: session.check_result is not None, 60, "the check does not end")
    yield 0.3
    yield from sidebar.push("fdda.train(")
    yield from job_done("train", LIMIT)
    yield from picture(OUT / "5_trained.png")
    done("trained")
    yield from sidebar.open_section("playback")
    yield from sidebar.push("fdda.bind(")
    yield from until(lambda: character().fdda.is_bound, 20, "the button binds nothing")
    check(not character().fdda.status, character().fdda.status)
    done("bound")
    yield from rest_mouse()
    yield from press("space")
    yield from until(lambda: main_screen().is_animation_playing, 5, "the space bar plays nothing")
    done("playing")
    yield 2.0
    yield from picture(OUT / "6_playing.png")
    yield from press("space")
    check(character().fdda.mode == "FDDA" and not character().fdda.status, character().fdda.status)
    (OUT / "times.json").write_text(json.dumps(times, indent=1))
    check(times["playing"] < LIMIT, f"it took {times['playing']:.0f} s")


def tick(path: Iterator[float] = way()) -> float | None:  # noqa: B008
    """The timer: one piece of the way."""
    try:
        return next(path)
    except StopIteration:
        bpy.ops.wm.quit_blender()
    except Exception:  # Blender would print it and stay open.
        traceback.print_exc()
        for _ in picture(OUT / "failed.png"):
            pass
        sys.stdout.flush()
        os._exit(1)
    return None


bpy.context.preferences.view.show_splash = False
bpy.app.timers.register(tick, first_interval=1.0, persistent=True)
