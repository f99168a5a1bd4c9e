# SPDX-License-Identifier: GPL-3.0-or-later
"""Values that panels and the polls of buttons ask for at every drawing, worked out once until something changes.

While an animation plays, Blender draws the sidebar at every frame. What a frame cannot change is kept: until Blender
evaluates a change, a file or an undo step is loaded, or a job tells, and for a second at most, as files change by
themselves; while an animation plays, until it stops. Without a window, where scripts look right after they have changed
something, nothing is kept.
"""

import functools
import time
from collections.abc import Callable

import bpy

SECONDS = 1.0

_kept: list[dict] = []
_until = 0.0


def kept(work: Callable) -> Callable:
    """Decorator: keep what a function returns for its arguments, which can be hashed; None is worked out each time."""
    values: dict[tuple, object] = {}
    _kept.append(values)

    @functools.wraps(work)
    def look(*key: object) -> object:
        global _until
        now = time.monotonic()
        if now > _until or bpy.app.background:
            if bpy.app.background or not _is_playing():
                forget()
            _until = now + SECONDS
        value = values.get(key)
        if value is None:
            value = work(*key)
            if value is not None:
                values[key] = value
        return value

    return look


def _is_playing() -> bool:
    """Whether an animation plays in some window."""
    return any(window.screen.is_animation_playing for window in bpy.context.window_manager.windows)


def forget() -> None:
    """Work everything out anew: something may have changed."""
    for values in _kept:
        values.clear()
