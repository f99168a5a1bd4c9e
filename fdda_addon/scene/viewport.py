# SPDX-License-Identifier: GPL-3.0-or-later
"""The 3D viewports of all windows."""

from collections.abc import Iterable

import bpy
from mathutils import Vector

DISTANCE = 2.0
"""Of the viewer, in radii of what is looked at: it fills most of the view with Blender's own lens of 50 mm."""


def redraw_views() -> None:
    """Draw the 3D viewports again."""
    for window in getattr(bpy.context.window_manager, "windows", ()):
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()


def frame_objects(objects: Iterable[bpy.types.Object]) -> None:
    """Have all 3D viewports of the file look at objects, from where they look now; works without a window."""
    corners = [o.matrix_world @ Vector(corner) for o in objects for corner in o.bound_box]
    if not corners:
        return
    low, high = (Vector([pick(axis) for axis in zip(*corners, strict=True)]) for pick in (min, max))
    radius = max((high - low).length / 2, 1e-6)
    for screen in bpy.data.screens:
        for space in (area.spaces.active for area in screen.areas if area.type == "VIEW_3D"):
            if space.region_3d.view_perspective == "CAMERA":
                space.region_3d.view_perspective = "PERSP"
            space.region_3d.view_location = (low + high) / 2
            space.region_3d.view_distance = DISTANCE * radius * max(1.0, space.lens / 50)
            space.clip_start = min(space.clip_start, radius / 10)
