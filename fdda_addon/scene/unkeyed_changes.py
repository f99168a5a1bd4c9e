# SPDX-License-Identifier: GPL-3.0-or-later
"""Keeps what the user has changed without keyframes when Blender sets the current frame again.

In a window, `Scene.frame_set` and every change of a driver variable make Blender set the frame once more, after the
operator or timer has ended. That evaluates all animation, and a bone that was posed without a keyframe jumps back.
"""

import bpy
from bpy.app.handlers import persistent

from .animated_values import AnimatedValues, read_scene_values, restore_values

_kept_frame: float | None = None
"""The frame that Blender will set again; None if nothing is to be kept."""
_is_last_turn = False
"""Whether the request ends with the next run of the timer."""
_values: AnimatedValues = []
"""Values to keep, while Blender sets that frame."""


def keep_unkeyed_changes() -> None:
    """Keep unkeyed changes of the scene's objects, of their data and of their shape keys at the current frame.

    Call it after a change that makes Blender set the current frame again. The request ends in the next turn of
    Blender's main loop, or with a change to another frame.
    """
    global _kept_frame, _is_last_turn
    if bpy.app.background:
        return
    discard_requests()
    _kept_frame, _is_last_turn = bpy.context.scene.frame_current_final, False
    bpy.app.timers.register(_end_turn, first_interval=0)


def discard_requests() -> None:
    """End the requests: the next change of the frame evaluates all animation, as usual."""
    global _kept_frame
    _kept_frame = None
    if bpy.app.timers.is_registered(_end_turn):
        bpy.app.timers.unregister(_end_turn)


def _end_turn() -> float | None:
    """Count turns of the main loop: Blender runs timers after operators, and sets the frame after timers."""
    global _kept_frame, _is_last_turn
    if not _is_last_turn:
        _is_last_turn = True
        return 0.0
    _kept_frame = None
    return None


@persistent
def _on_frame_change_pre(scene: bpy.types.Scene, *_: object) -> None:
    _values.clear()
    if _kept_frame is None:
        return
    if scene.frame_current_final != _kept_frame:
        discard_requests()
        return
    _values.extend(read_scene_values(scene))


@persistent
def _on_frame_change_post(*_: object) -> None:
    restore_values(_values)
    _values.clear()


HANDLERS = {"frame_change_pre": _on_frame_change_pre, "frame_change_post": _on_frame_change_post}
