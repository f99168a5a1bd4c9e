# SPDX-License-Identifier: GPL-3.0-or-later
"""Undo steps for changes that Blender adds none for: those that a property of the window manager makes."""

import bpy

PUSH_SECONDS = 0.3
"""A number that is dragged changes many times; all of that is one step."""

_message = ""


def push_undo_soon(message: str) -> None:
    """Add an undo step once no other change has followed for a moment.

    Args:
        message: name of the step in Blender's undo history.
    """
    global _message
    _message = message
    if bpy.app.background:
        return
    if bpy.app.timers.is_registered(_push):
        bpy.app.timers.unregister(_push)
    bpy.app.timers.register(_push, first_interval=PUSH_SECONDS)


def _push() -> None:
    windows = bpy.context.window_manager.windows
    if windows:
        with bpy.context.temp_override(window=windows[0]):
            bpy.ops.ed.undo_push(message=_message)


def unregister() -> None:
    """Add no step any more."""
    if bpy.app.timers.is_registered(_push):
        bpy.app.timers.unregister(_push)
