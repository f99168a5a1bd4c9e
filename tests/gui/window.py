# SPDX-License-Identifier: GPL-3.0-or-later
"""Control of Blender's window with mouse and keyboard, and screenshots of it.

A timer inside Blender runs these functions. A function that takes time is a generator of seconds to wait, so that
Blender handles events meanwhile.
"""

import functools
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import bpy
import numpy as np

EVENT_WAIT_SECONDS = 0.03
LEFT_BUTTON, RIGHT_BUTTON = 1, 3
"""Buttons of the mouse, by their numbers in xdotool."""
REDRAW_SECONDS = 0.25
"""Time until a region that was tagged for redrawing is on the screen."""
MIN_CHANNEL_DIFFERENCE = 0.45
"""Smallest difference between the strongest and the weakest channel of a pixel that counts as colored."""


class StepError(Exception):
    """A step did not have the expected effect. The text describes the problem."""


def require(condition: object, message: str) -> None:
    """Check a condition.

    Raises:
        StepError: the condition is false. `message` is its text.
    """
    if not condition:
        raise StepError(message)


def wait_until(condition: Callable[[], object], seconds: float, message: str) -> Iterator[float]:
    """Wait until a condition is true."""
    deadline = time.monotonic() + seconds
    while not condition():
        require(time.monotonic() < deadline, f"{message} ({seconds:.0f} s)")
        yield 0.1


def wait_for_events() -> Iterator[float]:
    """Wait until Blender has handled all mouse and keyboard events: its main loop runs timers before events."""
    for _ in range(3):
        yield EVENT_WAIT_SECONDS


def main_window() -> bpy.types.Window:
    return bpy.context.window_manager.windows[0]


def main_screen() -> bpy.types.Screen:
    return main_window().screen


def file_browser_count() -> int:
    """Return the number of open file browsers."""
    windows = bpy.context.window_manager.windows
    return sum(area.type == "FILE_BROWSER" for window in windows for area in window.screen.areas)


def view_area() -> bpy.types.Area:
    """Return the largest 3D View of the window."""
    areas = [area for area in main_screen().areas if area.type == "VIEW_3D"]
    return max(areas, key=lambda area: area.width * area.height)


def view_region(region_type: str) -> bpy.types.Region:
    """Return a region of the 3D View: 'WINDOW', or 'UI' for the sidebar."""
    return next(view_region for view_region in view_area().regions if view_region.type == region_type)


def region_override(region_type: str) -> object:
    """Override the context as if the mouse were over a region of the 3D View. For a `with` statement."""
    return bpy.context.temp_override(window=main_window(), area=view_area(), region=view_region(region_type))


@functools.cache
def x_window_id() -> str:
    """Return the id of Blender's window on the X server."""
    result = subprocess.run(
        ["xdotool", "search", "--onlyvisible", "--class", "blender"], capture_output=True, text=True
    )
    require(result.stdout.split(), "xdotool finds no window of Blender")
    return result.stdout.split()[-1]


def run_xdotool(*arguments: object) -> None:
    subprocess.run(["xdotool", *map(str, arguments)], check=True, capture_output=True)


def move_mouse(x: float, y: float) -> None:
    """Move the mouse to a position in pixels from the bottom left corner of the window."""
    run_xdotool("mousemove", "--window", x_window_id(), round(x), main_window().height - 1 - round(y))


def click(x: float, y: float, times: int = 1, button: int = LEFT_BUTTON) -> Iterator[float]:
    """Move the mouse to a position and click a button `times` times."""
    move_mouse(x, y)
    yield from wait_for_events()
    run_xdotool("click", "--repeat", times, "--delay", 60, button)
    yield from wait_for_events()


def press_mouse_button(action: str) -> None:
    """Press ("mousedown") or release ("mouseup") the left mouse button."""
    run_xdotool(action, LEFT_BUTTON)


def press_keys(*keys: str) -> Iterator[float]:
    """Press keys, by their names in xdotool. Blender sends them to the region below the mouse."""
    for key in keys:
        run_xdotool("key", key)
        yield from wait_for_events()


def park_mouse() -> Iterator[float]:
    """Move the mouse to an empty corner of the viewport, so that no button is highlighted and no tooltip is shown."""
    view = view_region("WINDOW")
    move_mouse(view.x + 0.35 * view.width, view.y + 0.06 * view.height)
    yield from wait_for_events()


def describe_button_below_mouse() -> str:
    """Return the operator call ("fdda.record(…)") or data path of the button below the mouse; empty without one."""
    manager = bpy.context.window_manager
    manager.clipboard = ""
    for operator_name, arguments in (
        ("copy_python_command_button", {}),
        ("copy_data_path_button", {"full_path": True}),
    ):
        operator = getattr(bpy.ops.ui, operator_name)
        if operator.poll():
            operator(**arguments)
            break
    return manager.clipboard


def start_playback() -> Iterator[float]:
    """Press the space bar over the viewport, and wait until the animation plays."""
    yield from park_mouse()
    yield from press_keys("space")
    yield from wait_until(lambda: main_screen().is_animation_playing, 5, "the space bar does not play the action")


def stop_playback() -> Iterator[float]:
    """Press the space bar again, and wait until the animation has stopped."""
    yield from press_keys("space")
    yield from wait_until(lambda: not main_screen().is_animation_playing, 5, "the space bar does not stop the action")


def close_browser(key: str) -> Iterator[float]:
    """Press "Escape" or "Return" with the mouse over the file browser, and wait until the browser is closed."""
    move_mouse(main_window().width / 2, main_window().height / 2)
    yield from wait_for_events()
    yield from press_keys(key)
    yield from wait_until(lambda: not file_browser_count(), 5, f"{key} does not close the file browser")
    yield 0.5


def redraw_window() -> Iterator[float]:
    """Redraw the whole window, because an open file browser may cover all of it."""
    for area in main_screen().areas:
        area.tag_redraw()
        for region in area.regions:
            region.tag_redraw()
    yield REDRAW_SECONDS


def save_screenshot(path: Path) -> Iterator[float]:
    """Write a screenshot of the window to a file, by ImageMagick: Blender's own are black on a virtual screen."""
    yield from redraw_window()
    subprocess.run(["import", "-window", x_window_id(), path], check=True, capture_output=True)


def read_pixels(path: Path) -> np.ndarray:
    """Return the pixels of an image file: (H, W, 3) float32, rows from the bottom."""
    image = bpy.data.images.load(str(path))
    try:
        values = np.empty(len(image.pixels), np.float32)
        image.pixels.foreach_get(values)
        return values.reshape(image.size[1], image.size[0], -1)[..., :3]
    finally:
        bpy.data.images.remove(image)


def colored_ratio(path: Path) -> float:
    """Return the ratio of strongly colored pixels in the middle half of the viewport of a screenshot.

    The lowest quarter has the legend, and the highest quarter the gizmos.
    """
    view, sidebar = view_region("WINDOW"), view_region("UI")
    bottom_row, top_row = view.y + view.height // 4, view.y + view.height * 3 // 4
    central_pixels = read_pixels(path)[bottom_row:top_row, view.x : sidebar.x]
    return float(np.mean(np.ptp(central_pixels, axis=2) > MIN_CHANNEL_DIFFERENCE))
