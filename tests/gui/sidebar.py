# SPDX-License-Identifier: GPL-3.0-or-later
"""The tab "FDDA" of the sidebar: its sections are opened, and its buttons found and pressed, with the mouse.

Blender does not tell where a button is. But it says what the button below the mouse would do, as its menu "Copy Python
Command" does: so the mouse goes down the sidebar until that is the button that is looked for.
"""

from collections.abc import Iterator

import bpy
from window import below_mouse, check, click, move, over, press, redraw, region, settle, view_area

SECTIONS = ("rig", "poses", "recording", "training", "playback", "evaluation", "models")
"""From the top."""
HEADER, PITCH = 15, 28
"""From the top of the sidebar to the middle of the first header, and between headers of closed sections, pixels."""
STEP = 18
"""Less than the height of a button."""
TRIES = 4

_drawn: set[str] = set()
_open_index = 0
_places: dict[str, float] = {}
"""How high buttons were found."""


def show() -> Iterator[float]:
    """Open the sidebar at its tab, and note from now on which sections are drawn."""
    view_area().spaces[0].show_region_ui = True
    yield 1.0  # Its region is a pixel wide before.
    region("UI").active_panel_category = "FDDA"
    yield from redraw()
    for name in SECTIONS:
        panel = getattr(bpy.types, f"FDDA_PT_{name}")
        panel.append(lambda _panel, _context, name=name: _drawn.add(name))


def open_sections() -> Iterator[float]:
    """Which sections are open; returns their names. Closed, they are not drawn."""
    forget_drawn()
    yield from redraw()
    return drawn()


def forget_drawn() -> None:
    """Forget which sections were drawn."""
    _drawn.clear()


def drawn() -> set[str]:
    """The sections that were drawn since that was forgotten."""
    return set(_drawn)


def open_section(name: str) -> Iterator[float]:
    """Close all sections with the mouse, from the top, and open one."""
    global _open_index
    opened = yield from open_sections()
    for index, section in enumerate(SECTIONS):
        for _ in range(TRIES):
            if section not in opened:
                break
            yield from _click_header(index)
            opened = yield from open_sections()
    _open_index = SECTIONS.index(name)
    yield from _click_header(_open_index)
    opened = yield from open_sections()
    check(opened == {name}, f"of the sections, {sorted(opened)} are open instead of {name}")


def _click_header(index: int) -> Iterator[float]:
    """Click a header whose predecessors are all closed."""
    sidebar, scale = region("UI"), bpy.context.preferences.system.ui_scale
    top = sidebar.y + sidebar.height
    yield from click(sidebar.x + 90 * scale, top - (HEADER + index * PITCH) * scale)


def find(what: str, across: float = 0.5) -> Iterator[float]:
    """Move the mouse down the sidebar onto a button; returns its place in the window.

    Args:
        what: part of what `below_mouse` says.
        across: how far from the left of the sidebar's content, 0 to 1.

    Raises:
        StepError: there is none.
    """
    sidebar, scale = region("UI"), bpy.context.preferences.system.ui_scale
    # The strip of the tabs is at the right.
    x = sidebar.x + 15 * scale + across * (sidebar.width - 60 * scale)
    first, last = sidebar.y + sidebar.height - (HEADER + _open_index * PITCH) * scale, sidebar.y
    going_down = [first - step * STEP * scale for step in range(int((first - last) / STEP / scale))]
    # First where it was the last time; twice, as the sidebar may be drawn anew meanwhile.
    known = [_places[what]] if what in _places else []
    for y in [*known, *going_down, *going_down]:
        move(x, y)
        yield from settle()
        with over("UI"):
            found = below_mouse()
        if what in found:
            _places[what] = y
            return x, y
    check(False, f"there is no button {what} in the sidebar")


def type_into(what: str, text: str) -> Iterator[float]:
    """Click a field in which one searches by name, as `find` finds it, and type; Return would choose what is found."""
    x, y = yield from find(what, across=0.7)
    yield from click(x, y)
    yield 0.5
    yield from press(*text)
    yield 0.3


def push(what: str, across: float = 0.5) -> Iterator[float]:
    """Press a button of the sidebar, as `find` finds it."""
    x, y = yield from find(what, across)
    yield from click(x, y)
