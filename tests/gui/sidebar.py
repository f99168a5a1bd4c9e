# SPDX-License-Identifier: GPL-3.0-or-later
"""Opens sections of the tab "FDDA" in the sidebar with the mouse, and finds and presses its buttons.

Blender's API has no positions of buttons, but an operator ("Copy Python Command") that describes the button below the
mouse. So a search moves the mouse down the sidebar until the description is that of the wanted button.
"""

from collections.abc import Iterator

import bpy
from window import (
    click,
    describe_button_below_mouse,
    move_mouse,
    press_keys,
    redraw_window,
    region_override,
    require,
    run_xdotool,
    view_area,
    view_region,
    wait_for_events,
)

SECTIONS = ("rig", "poses", "recording", "training", "playback", "evaluation", "models")
"""Names of the sections, from the top."""
HEADER_CENTER_PIXELS, HEADER_SPACING_PIXELS = 15, 28
"""Distance from the top of the sidebar to the center of the first header, and between headers of closed sections."""
SEARCH_STEP_PIXELS = 18
"""Distance between two mouse positions of a search. It is less than the height of a button."""
MAX_HEADER_CLICKS = 4
SUBPANEL_ROWS, CONTENT_ROWS = 12, 10
"""Number of rows below a button in which the header of a sub-panel is searched, and rows of its content."""

_drawn_sections: set[str] = set()
_open_index = 0
_button_heights: dict[str, float] = {}
"""Height in the window at which each button was found last, pixels, by identifier."""


def open_tab() -> Iterator[float]:
    """Open the tab "FDDA" of the sidebar, and record from now on which sections are drawn."""
    view_area().spaces[0].show_region_ui = True
    yield 1.0  # Until then its region is one pixel wide.
    view_region("UI").active_panel_category = "FDDA"
    yield from redraw_window()
    for name in SECTIONS:
        panel = getattr(bpy.types, f"FDDA_PT_{name}")
        panel.append(lambda _panel, _context, name=name: _drawn_sections.add(name))


def list_open_sections() -> Iterator[float]:
    """Return the names of the open sections. Blender does not draw closed ones."""
    clear_drawn_sections()
    yield from redraw_window()
    return drawn_sections()


def clear_drawn_sections() -> None:
    """Clear the record of drawn sections."""
    _drawn_sections.clear()


def drawn_sections() -> set[str]:
    """Return the names of the sections that were drawn since `clear_drawn_sections`."""
    return set(_drawn_sections)


def open_section(name: str) -> Iterator[float]:
    """Close all sections with the mouse, from the top, and open one of them."""
    global _open_index
    yield from _scroll("up")
    open_names = yield from list_open_sections()
    for index, section in enumerate(SECTIONS):
        for _ in range(MAX_HEADER_CLICKS):
            if section not in open_names:
                break
            yield from _click_header(index)
            open_names = yield from list_open_sections()
    _open_index = SECTIONS.index(name)
    yield from _click_header(_open_index)
    open_names = yield from list_open_sections()
    require(open_names == {name}, f"of the sections, {sorted(open_names)} are open instead of {name}")


def _click_header(index: int) -> Iterator[float]:
    """Click the header of a section while all sections above it are closed."""
    sidebar, scale = view_region("UI"), bpy.context.preferences.system.ui_scale
    top = sidebar.y + sidebar.height
    yield from click(sidebar.x + 90 * scale, top - (HEADER_CENTER_PIXELS + index * HEADER_SPACING_PIXELS) * scale)


def find_button(identifier: str, across: float = 0.5) -> Iterator[float]:
    """Move the mouse down the sidebar until it is over a button; return the position of the button in the window.

    If the button is not visible, the sidebar is scrolled down.

    Args:
        identifier: part of the text that `describe_button_below_mouse` returns for the button.
        across: horizontal position of the search in the sidebar, 0 at the left and 1 at the right.
    """
    sidebar, scale = view_region("UI"), bpy.context.preferences.system.ui_scale
    # The tabs are at the right of the content.
    x = sidebar.x + 15 * scale + across * (sidebar.width - 60 * scale)
    top = sidebar.y + sidebar.height - (HEADER_CENTER_PIXELS + _open_index * HEADER_SPACING_PIXELS) * scale
    step = SEARCH_STEP_PIXELS * scale
    search_heights = [top - index * step for index in range(int((top - sidebar.y) / step))]
    # The last position first; all others twice, because Blender may redraw the sidebar during the search.
    last_heights = [_button_heights[identifier]] if identifier in _button_heights else []
    for y in [*last_heights, *search_heights, *search_heights]:
        if identifier in (yield from description_at(x, y)):
            _button_heights[identifier] = y
            return x, y
    yield from _scroll("down")
    for y in [sidebar.y + sidebar.height - index * step for index in range(int(sidebar.height / step))]:
        if identifier in (yield from description_at(x, y)):
            return x, y
    require(False, f"there is no button {identifier} in the sidebar")


def type_into_search_field(identifier: str, search_text: str) -> Iterator[float]:
    """Click a search field, found as by `find_button`, and type a name. Return would then choose the match."""
    x, y = yield from find_button(identifier, across=0.7)
    yield from click(x, y)
    yield 0.5
    yield from press_keys(*search_text)
    yield 0.3


def press_button(identifier: str, across: float = 0.5) -> Iterator[float]:
    """Find a button of the sidebar (`find_button`) and click it."""
    x, y = yield from find_button(identifier, across)
    yield from click(x, y)


def open_subpanel(above: str, content: str, across: float = 0.5, across_above: float = 0.5) -> Iterator[float]:
    """Open a closed sub-panel of the open section with the mouse.

    Headers of sub-panels have no description, so each row without one is clicked until the content appears.

    Args:
        above: identifier of a button above the header, as for `find_button`.
        content: identifier of a button of the sub-panel.
        across, across_above: horizontal position of the button of the sub-panel, and of the button above.
    """
    sidebar, scale = view_region("UI"), bpy.context.preferences.system.ui_scale
    _, top = yield from find_button(above, across_above)
    header_x = sidebar.x + 0.4 * sidebar.width
    content_x = sidebar.x + 15 * scale + across * (sidebar.width - 60 * scale)
    step = SEARCH_STEP_PIXELS * scale
    for row in range(1, SUBPANEL_ROWS):
        y = top - row * step
        if (yield from description_at(header_x, y)):
            continue
        yield from click(header_x, y)
        yield from redraw_window()
        for content_row in range(1, CONTENT_ROWS):
            if content in (yield from description_at(content_x, y - content_row * step)):
                return
        # It was another sub-panel, which is closed again, or a label.
        yield from click(header_x, y)
        yield from redraw_window()
    require(False, f"no sub-panel below {above} has {content}")


def _scroll(direction: str) -> Iterator[float]:
    """Scroll the sidebar to its end with the mouse wheel, "up" or "down"."""
    sidebar = view_region("UI")
    # At the top there is always a panel; where there is none, the mouse wheel zooms the view.
    move_mouse(sidebar.x + 0.4 * sidebar.width, sidebar.y + sidebar.height - HEADER_CENTER_PIXELS)
    yield from wait_for_events()
    run_xdotool("click", "--repeat", 40, "--delay", 10, 4 if direction == "up" else 5)
    yield from redraw_window()


def description_at(x: float, y: float) -> Iterator[float]:
    """Return the description of the button at a position of the sidebar; empty without one."""
    move_mouse(x, y)
    yield from wait_for_events()
    with region_override("UI"):
        return describe_button_below_mouse()
