# SPDX-License-Identifier: GPL-3.0-or-later
"""What the tab FDDA costs while an action plays: `blender BOUND.blend --python benchmarks/sidebar.py -- OUT.json
[SECONDS [all]]`.

Plays the scene in the window as fast as it goes, the character out of view, in turn with the sidebar at its tab FDDA,
at Blender's own tab View, and closed. Of each the time of a frame, and what the code of the sections, of their lists
and of the polls of their buttons took of it: as Blender is at first, when it draws no sidebar while it plays, and with
*Properties Editors* ticked in its menu *Playback*. Sections are open as they are at first, or all of them. Writes
medians to OUT.json, prints them, and ends Blender.
"""

import json
import statistics
import sys
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import bpy

ROUNDS = 6
SECONDS = 3.0
SETTLE_SECONDS = 1.5
TABS = ("FDDA", "View", "")
"""Tabs of the sidebar; empty where it is closed."""
UNREACHABLE_FPS = 1000
"""Frames a second that are asked for: more than there can be."""

taken: dict[str, list[float]] = {}
"""Calls and seconds in the code of classes, by class and function, since it was emptied."""


def _timed_call(key: str, work: object, arguments: tuple) -> object:
    start = time.perf_counter()
    try:
        return work(*arguments)
    finally:
        entry = taken.setdefault(key, [0, 0.0])
        entry[0] += 1
        entry[1] += time.perf_counter() - start


def time_methods(cls: type) -> None:
    """Count the time in a class. Blender looks at how many arguments a function has, so each is written out."""

    def drawing(name: str, work: object) -> object:
        return lambda self, context: _timed_call(f"{cls.__name__}.{name}", work, (self, context))

    def polling(work: object) -> object:
        return classmethod(lambda own, context: _timed_call(f"{cls.__name__}.poll", work, (own, context)))

    def listing(work: object) -> object:
        count = work.__code__.co_argcount
        key = f"{cls.__name__}.draw_item"
        if count == 9:
            return lambda self, c, layout, data, item, icon, active, name, index: _timed_call(
                key, work, (self, c, layout, data, item, icon, active, name, index)
            )
        return lambda self, c, layout, data, item, icon, active, name: _timed_call(
            key, work, (self, c, layout, data, item, icon, active, name)
        )

    def filtering(work: object) -> object:
        return lambda self, context, data, name: _timed_call(
            f"{cls.__name__}.filter_items", work, (self, context, data, name)
        )

    if issubclass(cls, bpy.types.Panel):
        for name in ("draw", "draw_header_preset"):
            setattr(cls, name, drawing(name, getattr(cls, name)))
    if issubclass(cls, bpy.types.UIList):
        cls.draw_item = listing(cls.draw_item)
        if "filter_items" in cls.__dict__:
            cls.filter_items = filtering(cls.filter_items)
    elif hasattr(cls, "poll"):
        cls.poll = polling(cls.poll.__func__)


def addon_classes() -> list[type]:
    """The panels, lists and operators of the add-on."""
    found = [getattr(bpy.types, name) for name in dir(bpy.types) if name.startswith(("FDDA_PT_", "FDDA_UL_"))]
    operators = [cls for cls in bpy.types.Operator.__subclasses__() if cls.__name__.startswith("FDDA_OT_")]
    return [*found, *operators]


def find_sidebar() -> tuple[bpy.types.Area, bpy.types.Region]:
    area = max(
        (a for a in bpy.context.window_manager.windows[0].screen.areas if a.type == "VIEW_3D"),
        key=lambda a: a.width * a.height,
    )
    return area, next(region for region in area.regions if region.type == "UI")


def show_tab(tab: str) -> Iterator[float]:
    """Show a tab of the sidebar, or none."""
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


def measure(seconds: float, found: dict[str, dict]) -> Iterator[float]:
    """Alternate between the tabs; what is found goes into a dictionary."""
    scene, times = bpy.context.scene, []
    bpy.app.handlers.frame_change_post.append(lambda _scene, _graph: times.append(time.perf_counter()))
    scene.render.fps, scene.sync_mode = UNREACHABLE_FPS, "NONE"
    for tab in TABS:
        found[tab or "closed"] = {"frames": [], "code": [], "by": {}}
    for number in range(ROUNDS):
        # Each is first as often as the others.
        for tab in (*TABS[number % len(TABS) :], *TABS[: number % len(TABS)]):
            yield from show_tab(tab)
            of = found[tab or "closed"]
            toggle_animation()
            yield 0.3
            times.clear()
            taken.clear()
            yield seconds
            frames, now = len(times), dict(taken)
            toggle_animation()
            of["frames"] += [(b - a) * 1000 for a, b in pairwise(times)]
            of["code"].append(sum(entry[1] for entry in now.values()) * 1000 / frames)
            for key, (count, spent) in now.items():
                entry = of["by"].setdefault(key, [0.0, 0.0])
                entry[0] += count / frames / ROUNDS
                entry[1] += spent * 1000 / frames / ROUNDS
            yield 0.2


def main(out: Path, seconds: float, all_open: bool) -> Iterator[float]:
    """Measure, write and print."""
    space = find_sidebar()[0].spaces.active
    space.shading.type, space.overlay.show_overlays, space.show_gizmo = "WIREFRAME", False, False
    mesh_object = next(o for o in bpy.data.objects if o.type == "MESH" and o.fdda.is_bound)
    bpy.context.view_layer.objects.active = mesh_object
    # Evaluated, and not drawn: a processor that draws is busy with nothing else.
    space.region_3d.view_location.x += 1000
    for cls in addon_classes():
        time_methods(cls)
        if all_open and issubclass(cls, bpy.types.Panel):
            bpy.utils.unregister_class(cls)
            # Under another name: Blender remembers which were closed.
            cls.bl_idname, cls.bl_options = f"{cls.bl_idname}_open", set()
            bpy.utils.register_class(cls)
    said = {"unit": "ms", "blender": bpy.app.version_string, "as at first": {}, "drawn at every frame": {}}
    for when in ("as at first", "drawn at every frame"):
        screen = bpy.context.window_manager.windows[0].screen
        screen.use_play_properties_editors = when != "as at first"
        found: dict[str, dict] = {}
        yield from measure(seconds, found)
        print(f"Sidebar {when}")
        for way, of in found.items():
            by = sorted(of["by"].items(), key=lambda pair: -pair[1][1])
            frame, code = statistics.median(of["frames"]), statistics.median(of["code"])
            by = {key: {"calls": round(count, 2), "ms": round(ms, 4)} for key, (count, ms) in by}
            said[when][way] = {"frame": frame, "code": code, "by": by}
            print(f"  {way}: a frame {frame:.2f} ms, of which code {code:.3f}")
            for key, entry in by.items():
                print(f"    {key}: {entry['ms']:.4f} ({entry['calls']})")
    out.write_text(json.dumps(said, indent=1))
    sys.stdout.flush()
    bpy.ops.wm.quit_blender()


if __name__ == "__main__":
    bpy.context.preferences.view.show_splash = False
    arguments = sys.argv[sys.argv.index("--") + 1 :]
    path = main(Path(arguments[0]), float(arguments[1]) if len(arguments) > 1 else SECONDS, "all" in arguments)
    bpy.app.timers.register(lambda: next(path, None), first_interval=SETTLE_SECONDS, persistent=True)
