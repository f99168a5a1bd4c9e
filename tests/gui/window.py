# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's window as a person has it: a mouse, a keyboard, and what is on the screen.

Runs inside Blender, in a timer: whatever takes time is a generator of seconds to wait, so that Blender goes on.
"""

import functools
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import bpy
import numpy as np

MOMENT = 0.03
DRAWING = 0.25
"""Seconds until a region that was tagged is on the screen."""
VIVID = 0.45
"""Difference between the strongest and the weakest channel from which on a pixel has a color."""


class StepError(Exception):
    """A step did not do what it should; the text says what is wrong."""


def check(fact: object, otherwise: str) -> None:
    """Raises:
    StepError: the fact is none; it says what there is instead.
    """
    if not fact:
        raise StepError(otherwise)


def until(fact: Callable[[], object], seconds: float, otherwise: str) -> Iterator[float]:
    """Wait until something is true.

    Raises:
        StepError: it is not, after so many seconds.
    """
    end = time.monotonic() + seconds
    while not fact():
        check(time.monotonic() < end, f"{otherwise} ({seconds:.0f} s)")
        yield 0.1


def settle() -> Iterator[float]:
    """Wait until Blender has handled what the mouse and the keyboard did: timers come before events in its loop."""
    for _ in range(3):
        yield MOMENT


def main_window() -> bpy.types.Window:
    return bpy.context.window_manager.windows[0]


def main_screen() -> bpy.types.Screen:
    return main_window().screen


def browsers() -> int:
    """How many file browsers are open."""
    windows = bpy.context.window_manager.windows
    return sum(area.type == "FILE_BROWSER" for window in windows for area in window.screen.areas)


def view_area() -> bpy.types.Area:
    """The 3D View, the largest area of the window."""
    areas = [area for area in main_screen().areas if area.type == "VIEW_3D"]
    return max(areas, key=lambda area: area.width * area.height)


def region(kind: str) -> bpy.types.Region:
    """A region of the 3D View: 'WINDOW', or 'UI' for the sidebar."""
    return next(region for region in view_area().regions if region.type == kind)


def over(kind: str) -> object:
    """Context manager: operators find the 3D View and one of its regions, as with the mouse over it."""
    return bpy.context.temp_override(window=main_window(), area=view_area(), region=region(kind))


@functools.cache
def x_window() -> str:
    """The X server's number of Blender's window."""
    found = subprocess.run(["xdotool", "search", "--onlyvisible", "--class", "blender"], capture_output=True, text=True)
    check(found.stdout.split(), "xdotool finds no window of Blender")
    return found.stdout.split()[-1]


def _xdotool(*arguments: object) -> None:
    subprocess.run(["xdotool", *map(str, arguments)], check=True, capture_output=True)


def move(x: float, y: float) -> None:
    """Move the mouse; pixels from the bottom left of the window, as Blender counts."""
    _xdotool("mousemove", "--window", x_window(), round(x), main_window().height - 1 - round(y))


def click(x: float, y: float, times: int = 1) -> Iterator[float]:
    """Move the mouse somewhere and press its left button."""
    move(x, y)
    yield from settle()
    _xdotool("click", "--repeat", times, "--delay", 60, 1)
    yield from settle()


def button(what: str) -> None:
    """Press the left button of the mouse, "mousedown", or let go of it, "mouseup"."""
    _xdotool(what, 1)


def press(*keys: str) -> Iterator[float]:
    """Press keys, named as xdotool does; they go to what is below the mouse."""
    for key in keys:
        _xdotool("key", key)
        yield from settle()


def rest_mouse() -> Iterator[float]:
    """Put the mouse into an empty corner of the viewport: no button is lit and no tooltip shown."""
    view = region("WINDOW")
    move(view.x + 0.35 * view.width, view.y + 0.06 * view.height)
    yield from settle()


def below_mouse() -> str:
    """What the button below the mouse does: "fdda.record(…)", or the property that it shows; empty where none is."""
    manager = bpy.context.window_manager
    manager.clipboard = ""
    for copy, options in (("copy_python_command_button", {}), ("copy_data_path_button", {"full_path": True})):
        operator = getattr(bpy.ops.ui, copy)
        if operator.poll():
            operator(**options)
            break
    return manager.clipboard


def play() -> Iterator[float]:
    """Press space over the viewport: the action plays."""
    yield from rest_mouse()
    yield from press("space")
    yield from until(lambda: main_screen().is_animation_playing, 5, "the space bar does not play the action")


def stop() -> Iterator[float]:
    """Press space again: it plays no more."""
    yield from press("space")
    yield from until(lambda: not main_screen().is_animation_playing, 5, "the space bar does not stop the action")


def close_browser(key: str) -> Iterator[float]:
    """Press a key, "Escape" or "Return", with the mouse over the file browser: it closes."""
    move(main_window().width / 2, main_window().height / 2)
    yield from settle()
    yield from press(key)
    yield from until(lambda: not browsers(), 5, f"{key} does not close the file browser")
    yield 0.5


def redraw() -> Iterator[float]:
    """Draw the window again; a file browser may take all of it."""
    for area in main_screen().areas:
        area.tag_redraw()
        for each in area.regions:
            each.tag_redraw()
    yield DRAWING


def picture(path: Path) -> Iterator[float]:
    """Write what is on the screen into a file: Blender's own screenshots are black on a virtual screen."""
    yield from redraw()
    subprocess.run(["import", "-window", x_window(), path], check=True, capture_output=True)


def pixels(path: Path) -> np.ndarray:
    """(H, W, 3) float32, rows from the bottom: the picture in a file."""
    image = bpy.data.images.load(str(path))
    try:
        values = np.empty(len(image.pixels), np.float32)
        image.pixels.foreach_get(values)
        return values.reshape(image.size[1], image.size[0], -1)[..., :3]
    finally:
        bpy.data.images.remove(image)


def vivid_part(path: Path) -> float:
    """Which part of the viewport in a picture has a strong color. Left out are the lowest quarter, where the legend
    is, and the highest, where the gizmos are."""
    view, sidebar = region("WINDOW"), region("UI")
    low, high = view.y + view.height // 4, view.y + view.height * 3 // 4
    inside = pixels(path)[low:high, view.x : sidebar.x]
    return float(np.mean(np.ptp(inside, axis=2) > VIVID))
