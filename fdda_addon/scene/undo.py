# SPDX-License-Identifier: GPL-3.0-or-later
"""Adds undo steps for changes that properties of the window manager make, for which Blender adds none."""

from functools import partial

import bpy
from bpy.app.handlers import persistent

PUSH_DELAY_SECONDS = 0.3
"""Time without a change before a step is added, because dragging a number changes it many times."""


def push_undo_soon(message: str) -> None:
    """Add an undo step when no other change has followed for `PUSH_DELAY_SECONDS`.

    Args:
        message: name of the step in Blender's undo history, one of `STEPS`.
    """
    if bpy.app.background:
        return
    cancel_push()
    bpy.app.timers.register(STEPS[message], first_interval=PUSH_DELAY_SECONDS)


def _push_undo(message: str) -> None:
    windows = bpy.context.window_manager.windows
    if windows:
        with bpy.context.temp_override(window=windows[0]):
            bpy.ops.ed.undo_push(message=message)


STEPS = {message: partial(_push_undo, message) for message in ("Preview Pose", "Choose Action")}
"""The timers that add undo steps, by the names of the steps: Blender finds a registered timer by its identity."""


@persistent
def cancel_push(*_: object) -> None:
    """Cancel the pending undo step."""
    for timer in STEPS.values():
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)


HANDLERS = {"undo_pre": cancel_push, "redo_pre": cancel_push}
"""An undo discards the change. A step that is added afterwards would remove the steps that redo needs."""
