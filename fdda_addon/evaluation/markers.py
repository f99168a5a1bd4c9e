# SPDX-License-Identifier: GPL-3.0-or-later
"""Timeline markers at the worst frames of an action."""

import re

import bpy

_NAME = r"FDDA \d+: \d+\.\d+ mm"
"""Ours are known by their names: Blender 5 lets markers carry nothing else."""


def place(scene: bpy.types.Scene, worst: list[tuple[int, float]]) -> None:
    """Mark frames, and none else.

    Args:
        scene: whose timeline.
        worst: frame and largest error in mm, the worst first.
    """
    remove(scene)
    for rank, (frame, error_mm) in enumerate(worst, 1):
        scene.timeline_markers.new(f"FDDA {rank}: {error_mm:.2f} mm", frame=frame)


def find(scene: bpy.types.Scene) -> list[bpy.types.TimelineMarker]:
    """Our markers."""
    return [marker for marker in scene.timeline_markers if re.fullmatch(_NAME, marker.name)]


def remove(scene: bpy.types.Scene) -> int:
    """Remove our markers, and none else; returns how many there were."""
    found = find(scene)
    for marker in found:
        scene.timeline_markers.remove(marker)
    return len(found)
