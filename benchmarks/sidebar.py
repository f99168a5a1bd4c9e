# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure how much time the tab FDDA takes while an action plays.

    blender BOUND.blend --python benchmarks/sidebar.py -- OUT.json [SECONDS [all]]

Plays the scene in the window at the highest possible rate, with the character out of view. Alternates between the tab
FDDA of the sidebar, Blender's tab View, and a closed sidebar. For each, measures the time of a frame and the time in
the code of the add-on: in the sections, in their lists, and in the polls of their buttons.

Measures all of this twice: with Blender's defaults, which do not redraw the sidebar during playback, and with
*Properties Editors* enabled in the menu *Playback*. The sections are open as by default; with `all`, every section is
open. Writes the medians to OUT.json, prints them, and quits Blender; the preferences stay as they were. Takes one and a
half minutes with 3 SECONDS, and longer where a frame takes long. After an exception the exit status is 1.
"""

import json
import os
import statistics
import sys
import time
import traceback
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import bpy

ROUNDS = 6
SECONDS = 3.0
SETTLE_SECONDS = 1.5
MIN_FRAMES, MAX_EXTENSIONS = 3, 9
"""Number of frames that a measurement needs, and how often it is extended by its own duration to reach it."""
TABS = ("FDDA", "View", "")
"""Tabs of the sidebar; the empty name means that the sidebar is closed."""
UNREACHABLE_FPS = 1000
"""Frame rate of the scene: higher than Blender can reach, so that it never waits."""

code_times: dict[str, list[float]] = {}
"""Number of calls and seconds, by class and function; cleared before each measurement."""


def _timed_call(key: str, function: object, arguments: tuple) -> object:
    start = time.perf_counter()
    try:
        return function(*arguments)
    finally:
        entry = code_times.setdefault(key, [0, 0.0])
        entry[0] += 1
        entry[1] += time.perf_counter() - start


def time_methods(cls: type) -> None:
    """Replace the drawing and polling methods of a class with timed ones.

    Blender checks the number of arguments of each method, so the wrappers list every argument.
    """

    def wrap_draw(name: str, function: object) -> object:
        return lambda self, context: _timed_call(f"{cls.__name__}.{name}", function, (self, context))

    def wrap_poll(function: object) -> object:
        return classmethod(lambda poll_cls, context: _timed_call(f"{cls.__name__}.poll", function, (poll_cls, context)))

    def wrap_draw_item(function: object) -> object:
        argument_count = function.__code__.co_argcount
        key = f"{cls.__name__}.draw_item"
        if argument_count == 9:
            return lambda self, context, layout, data, item, icon, active, name, index: _timed_call(
                key, function, (self, context, layout, data, item, icon, active, name, index)
            )
        return lambda self, context, layout, data, item, icon, active, name: _timed_call(
            key, function, (self, context, layout, data, item, icon, active, name)
        )

    def wrap_filter_items(function: object) -> object:
        return lambda self, context, data, name: _timed_call(
            f"{cls.__name__}.filter_items", function, (self, context, data, name)
        )

    if issubclass(cls, bpy.types.Panel):
        for name in ("draw", "draw_header_preset"):
            setattr(cls, name, wrap_draw(name, getattr(cls, name)))
    if issubclass(cls, bpy.types.UIList):
        cls.draw_item = wrap_draw_item(cls.draw_item)
        if "filter_items" in cls.__dict__:
            cls.filter_items = wrap_filter_items(cls.filter_items)
    elif hasattr(cls, "poll"):
        cls.poll = wrap_poll(cls.poll.__func__)


def addon_classes() -> list[type]:
    """Return the panels, lists and operators of the add-on."""
    classes = [getattr(bpy.types, name) for name in dir(bpy.types) if name.startswith(("FDDA_PT_", "FDDA_UL_"))]
    operators = [cls for cls in bpy.types.Operator.__subclasses__() if cls.__name__.startswith("FDDA_OT_")]
    return [*classes, *operators]


def find_sidebar() -> tuple[bpy.types.Area, bpy.types.Region]:
    area = max(
        (a for a in bpy.context.window_manager.windows[0].screen.areas if a.type == "VIEW_3D"),
        key=lambda a: a.width * a.height,
    )
    return area, next(region for region in area.regions if region.type == "UI")


def show_tab(tab: str) -> Iterator[float]:
    """Show a tab of the sidebar, or close the sidebar if `tab` is empty."""
    area, region = find_sidebar()
    area.spaces.active.show_region_ui = bool(tab)
    yield 0.5
    if tab:
        region.active_panel_category = tab
    area.tag_redraw()
    yield 0.5


def toggle_animation() -> None:
    with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
        bpy.ops.screen.animation_play()


def measure(seconds: float, times_by_tab: dict[str, dict]) -> Iterator[float]:
    """Play with each tab alternately and add the measured times to `times_by_tab`."""
    scene, frame_end_times = bpy.context.scene, []
    bpy.app.handlers.frame_change_post.append(lambda _scene, _graph: frame_end_times.append(time.perf_counter()))
    scene.render.fps, scene.sync_mode = UNREACHABLE_FPS, "NONE"
    for tab in TABS:
        times_by_tab[tab or "closed"] = {"frames": [], "code": [], "by": {}}
    for round_index in range(ROUNDS):
        # Start each round with the next tab, so that no tab is always first.
        first = round_index % len(TABS)
        for tab in (*TABS[first:], *TABS[:first]):
            yield from show_tab(tab)
            tab_times = times_by_tab[tab or "closed"]
            toggle_animation()
            yield 0.3
            frame_end_times.clear()
            code_times.clear()
            yield seconds
            for _ in range(MAX_EXTENSIONS):
                if len(frame_end_times) < MIN_FRAMES:
                    yield seconds
            if len(frame_end_times) < MIN_FRAMES:
                raise SystemExit(f"Blender evaluated {len(frame_end_times)} frames; give more SECONDS.")
            frame_count, measured_code = len(frame_end_times), dict(code_times)
            toggle_animation()
            tab_times["frames"] += [(b - a) * 1000 for a, b in pairwise(frame_end_times)]
            tab_times["code"].append(sum(entry[1] for entry in measured_code.values()) * 1000 / frame_count)
            for key, (count, code_seconds) in measured_code.items():
                entry = tab_times["by"].setdefault(key, [0.0, 0.0])
                entry[0] += count / frame_count / ROUNDS
                entry[1] += code_seconds * 1000 / frame_count / ROUNDS
            yield 0.2


def main(out: Path, seconds: float, open_all: bool) -> Iterator[float]:
    """Measure with both settings of Blender, write the medians to a file and print them."""
    space = find_sidebar()[0].spaces.active
    space.shading.type, space.overlay.show_overlays, space.show_gizmo = "WIREFRAME", False, False
    mesh_object = next((o for o in bpy.data.objects if o.type == "MESH" and o.fdda.is_bound), None)
    if mesh_object is None:
        raise SystemExit(f"'{bpy.data.filepath}' has no mesh with a bound model.")
    bpy.context.view_layer.objects.active = mesh_object
    # Out of view, the character is evaluated but not drawn: without a GPU, drawing takes all processor time.
    space.region_3d.view_location.x += 1000
    for cls in addon_classes():
        time_methods(cls)
        if open_all and issubclass(cls, bpy.types.Panel):
            bpy.utils.unregister_class(cls)
            # Register the panel under a different name, because Blender remembers which panels were closed.
            cls.bl_idname, cls.bl_options = f"{cls.bl_idname}_open", set()
            bpy.utils.register_class(cls)
    results = {"unit": "ms", "blender": bpy.app.version_string, "as at first": {}, "drawn at every frame": {}}
    for setting in ("as at first", "drawn at every frame"):
        screen = bpy.context.window_manager.windows[0].screen
        screen.use_play_properties_editors = setting != "as at first"
        times_by_tab: dict[str, dict] = {}
        yield from measure(seconds, times_by_tab)
        print(f"Sidebar {setting}", flush=True)
        for tab, tab_times in times_by_tab.items():
            entries = sorted(tab_times["by"].items(), key=lambda pair: -pair[1][1])
            frame, code = statistics.median(tab_times["frames"]), statistics.median(tab_times["code"])
            times_by_method = {key: {"calls": round(count, 2), "ms": round(ms, 4)} for key, (count, ms) in entries}
            results[setting][tab] = {"frame": frame, "code": code, "by": times_by_method}
            print(f"  {tab}: a frame {frame:.2f} ms, of which code of the add-on {code:.3f}", flush=True)
            for key, entry in times_by_method.items():
                print(f"    {key}: {entry['ms']:.4f} ({entry['calls']})")
    out.write_text(json.dumps(results, indent=1))
    sys.stdout.flush()
    bpy.ops.wm.quit_blender()


def next_wait(steps: Iterator[float]) -> float | None:
    """Return the seconds until the next step; end Blender with status 1 where a step raises an exception."""
    try:
        return next(steps, None)
    except SystemExit as exit_request:
        print(exit_request, file=sys.stderr, flush=True)
    except Exception:
        traceback.print_exc()
    sys.stdout.flush()
    os._exit(1)


if __name__ == "__main__":
    bpy.context.preferences.use_preferences_save = False
    bpy.context.preferences.view.show_splash = False
    arguments = sys.argv[sys.argv.index("--") + 1 :]
    steps = main(Path(arguments[0]), float(arguments[1]) if len(arguments) > 1 else SECONDS, "all" in arguments)
    bpy.app.timers.register(lambda: next_wait(steps), first_interval=SETTLE_SECONDS, persistent=True)
