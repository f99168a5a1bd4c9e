# SPDX-License-Identifier: GPL-3.0-or-later
"""Redraws and frames the 3D viewports."""

from collections.abc import Iterable

import bpy
from mathutils import Vector

VIEW_DISTANCE_RADII = 2.0
"""Distance of the viewer from framed objects, relative to their radius. With Blender's default lens, the objects fill
most of the view."""
DEFAULT_LENS_MM = 50


def redraw_views() -> None:
    """Redraw all 3D viewports."""
    for window in getattr(bpy.context.window_manager, "windows", ()):
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()


def frame_objects(objects: Iterable[bpy.types.Object]) -> None:
    """Frame objects in all 3D viewports of the file, without changing the view direction; works without a window."""
    corners = [o.matrix_world @ Vector(corner) for o in objects for corner in o.bound_box]
    if not corners:
        return
    low_corner, high_corner = (
        Vector([min_or_max(axis) for axis in zip(*corners, strict=True)]) for min_or_max in (min, max)
    )
    radius = max((high_corner - low_corner).length / 2, 1e-6)
    center_views((low_corner + high_corner) / 2, radius)


def center_views(center: Vector, radius: float) -> None:
    """Look at a sphere in all 3D viewports of the file, without changing the view direction; works without a window.

    Args:
        center, radius: of the sphere, world space.
    """
    for screen in bpy.data.screens:
        for space in (area.spaces.active for area in screen.areas if area.type == "VIEW_3D"):
            if space.region_3d.view_perspective == "CAMERA":
                space.region_3d.view_perspective = "PERSP"
            space.region_3d.view_location = center
            space.region_3d.view_distance = VIEW_DISTANCE_RADII * radius * max(1.0, space.lens / DEFAULT_LENS_MM)
            space.clip_start = min(space.clip_start, radius / 10)
