# SPDX-License-Identifier: GPL-3.0-or-later
"""Keeps what the user has changed without keyframes when Blender sets the current frame again.

In a window, `Scene.frame_set` and every change of a driver variable make Blender set the frame once more, after the
operator or timer has ended. That evaluates all animation, and a bone that was posed without a keyframe jumps back.
"""

from dataclasses import dataclass, field

import bpy
from bpy.app.handlers import persistent

from .animated_values import AnimatedValues, read_scene_values, restore_values


@dataclass
class _Request:
    """What is to be kept.

    Attributes:
        frame: the frame that Blender will set again; None if nothing is to be kept.
        is_last_turn: whether the request ends with the next run of the timer.
        values: values to keep, while Blender sets that frame.
    """

    frame: float | None = None
    is_last_turn: bool = False
    values: AnimatedValues = field(default_factory=list)


_request = _Request()


def keep_unkeyed_changes() -> None:
    """Keep unkeyed changes of the scene's objects, of their data and of their shape keys at the current frame.

    Call it after a change that makes Blender set the current frame again. The request ends in the next turn of
    Blender's main loop, or with a change to another frame.
    """
    if bpy.app.background:
        return
    discard_requests()
    _request.frame, _request.is_last_turn = bpy.context.scene.frame_current_final, False
    bpy.app.timers.register(_end_turn, first_interval=0)


def discard_requests() -> None:
    """End the requests: the next change of the frame evaluates all animation, as usual."""
    _request.frame = None
    if bpy.app.timers.is_registered(_end_turn):
        bpy.app.timers.unregister(_end_turn)


def _end_turn() -> float | None:
    """Count turns of the main loop: Blender runs timers after operators, and sets the frame after timers."""
    if not _request.is_last_turn:
        _request.is_last_turn = True
        return 0.0
    _request.frame = None
    return None


@persistent
def _on_frame_change_pre(scene: bpy.types.Scene, *_: object) -> None:
    _request.values.clear()
    if _request.frame is None:
        return
    if scene.frame_current_final != _request.frame:
        discard_requests()
        return
    _request.values.extend(read_scene_values(scene))


@persistent
def _on_frame_change_post(*_: object) -> None:
    restore_values(_request.values)
    _request.values.clear()


HANDLERS = {"frame_change_pre": _on_frame_change_pre, "frame_change_post": _on_frame_change_post}
