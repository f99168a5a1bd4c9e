# SPDX-License-Identifier: GPL-3.0-or-later
"""Caches values that panels and the polls of buttons need for every redraw.

While an animation plays, Blender redraws the sidebar in every frame. A cached value lasts until Blender evaluates a
change, loads a file or an undo step, or a job clears the cache. It lasts a second at most, because Blender does not
report changes of files; while an animation plays, it lasts until the animation stops. Without a window nothing is
cached: scripts read values right after they have changed something.

What takes longer to compute than a redraw may last depends on few inputs, such as the time of a file. `computed_once`
stores it, until the inputs change or another file is opened.
"""

import functools
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

import bpy

MAX_AGE_SECONDS = 1.0
Value = TypeVar("Value")


@dataclass
class _DrawCache:
    """What is stored for drawing.

    Attributes:
        results: results of `draw_cached` functions, by function and arguments.
        expires_at: time of `time.monotonic` at which they are dropped.
        computed: the inputs and values of `computed_once`, by name.
        actions: differs after each change of an action (`actions_state`).
    """

    results: dict[tuple, object] = field(default_factory=dict)
    expires_at: float = 0.0
    computed: dict[tuple, tuple[tuple, object]] = field(default_factory=dict)
    actions: object = field(default_factory=object)


_cache = _DrawCache()


def draw_cached(function: Callable[..., Value]) -> Callable[..., Value]:
    """Cache the results of a function by its arguments, which must be hashable; None is not cached."""

    @functools.wraps(function)
    def cached_function(*arguments: object) -> Value:
        now = time.monotonic()
        if now > _cache.expires_at or bpy.app.background:
            if bpy.app.background or not any(w.screen.is_animation_playing for w in bpy.context.window_manager.windows):
                clear()
            _cache.expires_at = now + MAX_AGE_SECONDS
        key = (function, *arguments)
        result = _cache.results.get(key)
        if result is None:
            result = function(*arguments)
            if result is not None:
                _cache.results[key] = result
        return result

    return cached_function


def computed_once(name: tuple, inputs: tuple, compute: Callable[[], Value]) -> Value:
    """Return a value that is computed again only when its inputs change.

    Args:
        name: what the value is and whose. One value is stored by name.
        inputs: everything that the value depends on. Objects without `__eq__` are compared by identity.
        compute: returns the value.
    """
    stored = _cache.computed.get(name)
    if stored is None or stored[0] != inputs:
        stored = _cache.computed[name] = inputs, compute()
    return stored[1]


def actions_state() -> object:
    """Return an object that is the same until an action may have changed, as an input of `computed_once`.

    Without a window each call returns another: scripts read actions right after they have changed them.
    """
    return object() if bpy.app.background else _cache.actions


def forget_actions() -> None:
    """Let what follows from actions be computed again, because one of them may have changed."""
    _cache.actions = object()


def clear() -> None:
    """Drop the results of `draw_cached` functions, because something may have changed."""
    _cache.results.clear()


def clear_all() -> None:
    """Drop everything, because another file was opened or the add-on is disabled."""
    clear()
    forget_actions()
    _cache.computed.clear()
