# SPDX-License-Identifier: GPL-3.0-or-later
"""Places timeline markers at the worst frames of an action."""

import re

import bpy

_NAME_PATTERN = r"FDDA \d+: \d+\.\d+ mm"
"""Regular expression of the names of FDDA's markers. They are identified by their names, because markers have no custom
properties in Blender 5."""


def place(scene: bpy.types.Scene, worst_frames: list[tuple[int, float]]) -> None:
    """Place a marker at each of the worst frames, and remove all other FDDA markers.

    Args:
        scene: the scene with the timeline.
        worst_frames: pairs of frame and largest error in mm, worst first.
    """
    remove(scene)
    for rank, (frame, error_mm) in enumerate(worst_frames, 1):
        scene.timeline_markers.new(f"FDDA {rank}: {error_mm:.2f} mm", frame=frame)


def find(scene: bpy.types.Scene) -> list[bpy.types.TimelineMarker]:
    """Find the FDDA markers in a scene."""
    return [marker for marker in scene.timeline_markers if re.fullmatch(_NAME_PATTERN, marker.name)]


def remove(scene: bpy.types.Scene) -> int:
    """Remove the FDDA markers from a scene, and return their number."""
    markers = find(scene)
    for marker in markers:
        scene.timeline_markers.remove(marker)
    return len(markers)
