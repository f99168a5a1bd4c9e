# SPDX-License-Identifier: GPL-3.0-or-later
"""Adds undo steps for changes that properties of the window manager make, for which Blender adds none."""

import bpy
from bpy.app.handlers import persistent

PUSH_DELAY_SECONDS = 0.3
"""Time without a change before a step is added, because dragging a number changes it many times."""

_pending_message = ""


def push_undo_soon(message: str) -> None:
    """Add an undo step when no other change has followed for `PUSH_DELAY_SECONDS`.

    Args:
        message: name of the step in Blender's undo history.
    """
    global _pending_message
    _pending_message = message
    if bpy.app.background:
        return
    cancel_push()
    bpy.app.timers.register(_push_undo, first_interval=PUSH_DELAY_SECONDS)


def _push_undo() -> None:
    windows = bpy.context.window_manager.windows
    if windows:
        with bpy.context.temp_override(window=windows[0]):
            bpy.ops.ed.undo_push(message=_pending_message)


@persistent
def cancel_push(*_: object) -> None:
    """Cancel the pending undo step."""
    if bpy.app.timers.is_registered(_push_undo):
        bpy.app.timers.unregister(_push_undo)


HANDLERS = {"undo_pre": cancel_push, "redo_pre": cancel_push}
"""An undo discards the change. A step that is added afterwards would remove the steps that redo needs."""
