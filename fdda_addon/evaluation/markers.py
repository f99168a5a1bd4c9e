# SPDX-License-Identifier: GPL-3.0-or-later
"""Places timeline markers at the worst frames of an action."""

import re

import bpy

_NAME = r"FDDA \d+: \d+\.\d+ mm"
"""Pattern of the names of our markers, which identifies them: Blender 5 allows no custom properties on markers."""


def place(scene: bpy.types.Scene, worst: list[tuple[int, float]]) -> None:
    """Place a marker at each of the worst frames, and remove our other markers.

    Args:
        scene: the scene with the timeline.
        worst: frame and largest error in mm, the worst first.
    """
    remove(scene)
    for rank, (frame, error_mm) in enumerate(worst, 1):
        scene.timeline_markers.new(f"FDDA {rank}: {error_mm:.2f} mm", frame=frame)


def find(scene: bpy.types.Scene) -> list[bpy.types.TimelineMarker]:
    """Return our markers."""
    return [marker for marker in scene.timeline_markers if re.fullmatch(_NAME, marker.name)]


def remove(scene: bpy.types.Scene) -> int:
    """Remove our markers; return their number."""
    markers = find(scene)
    for marker in markers:
        scene.timeline_markers.remove(marker)
    return len(markers)
