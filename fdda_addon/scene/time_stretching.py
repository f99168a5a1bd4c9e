# SPDX-License-Identifier: GPL-3.0-or-later
"""Converts frames of the scene to the times of animation, which differ where the scene stretches time.

Keyframes, strips of the NLA, mesh caches and simulations have times. A frame of the scene shows the time that follows
from **Old** and **New** of Time Stretching in the output settings.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager

import bpy

from .temporary_state import temporary_attributes

ROUNDING_TOLERANCE = 1e-4
"""A frame that is nearer to a whole frame counts as whole."""


def time_ratio() -> float:
    """Return the time that passes from one frame of the scene to the next; 1 without time stretching."""
    render = bpy.context.scene.render
    return render.frame_map_old / render.frame_map_new


def time_to_frame(time: float) -> float:
    """Return the frame of the scene that shows a time of the animation, with a fraction."""
    render = bpy.context.scene.render
    return time * render.frame_map_new / render.frame_map_old


def frames_covering(times: range) -> range:
    """Return the frames of the scene from the last one before the first of some times to the first after the last."""
    first, last = time_to_frame(times[0]), time_to_frame(times[-1])
    return range(math.floor(first + ROUNDING_TOLERANCE), math.ceil(last - ROUNDING_TOLERANCE) + 1)


@contextmanager
def unstretched_time() -> Iterator[None]:
    """Switch time stretching off in the block, so that frames are times. The scene stays at the same time.

    Enter it inside of `temporary_pose`, which restores the frame.
    """
    scene, render = bpy.context.scene, bpy.context.scene.render
    if render.frame_map_old == render.frame_map_new:
        yield
        return
    time = scene.frame_current_final
    with temporary_attributes(render, frame_map_old=100, frame_map_new=100):
        scene.frame_set(math.floor(time), subframe=time - math.floor(time))
        yield
