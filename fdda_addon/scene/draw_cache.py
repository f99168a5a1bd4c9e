# SPDX-License-Identifier: GPL-3.0-or-later
"""Caches values that panels and the polls of buttons need for every redraw.

While an animation plays, Blender redraws the sidebar in every frame. A cached value lasts until Blender evaluates a
change, loads a file or an undo step, or a job clears the cache. It lasts a second at most, because Blender does not
report changes of files; while an animation plays, it lasts until the animation stops. Without a window nothing is
cached: scripts read values right after they have changed something.
"""

import functools
import time
from collections.abc import Callable

import bpy

MAX_AGE_SECONDS = 1.0

_caches: list[dict] = []
_expires_at = 0.0


def draw_cached(function: Callable) -> Callable:
    """Cache the results of a function by its arguments, which must be hashable; None is not cached."""
    cached_results: dict[tuple, object] = {}
    _caches.append(cached_results)

    @functools.wraps(function)
    def cached_function(*arguments: object) -> object:
        global _expires_at
        now = time.monotonic()
        if now > _expires_at or bpy.app.background:
            if bpy.app.background or not _is_animation_playing():
                clear()
            _expires_at = now + MAX_AGE_SECONDS
        result = cached_results.get(arguments)
        if result is None:
            result = function(*arguments)
            if result is not None:
                cached_results[arguments] = result
        return result

    return cached_function


def _is_animation_playing() -> bool:
    """Return whether an animation plays in some window."""
    return any(window.screen.is_animation_playing for window in bpy.context.window_manager.windows)


def clear() -> None:
    """Clear the cache, because something may have changed."""
    for values in _caches:
        values.clear()
