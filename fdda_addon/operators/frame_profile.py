# SPDX-License-Identifier: GPL-3.0-or-later
"""The operator of the section "Rig" that profiles a frame."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import bpy

from .job import JobOperator
from .rig_operator import RigOperator

if TYPE_CHECKING:  # Blender starts without numpy.
    from ..timing.frame_profile import FrameProfile

_profiles: "dict[int, FrameProfile]" = {}
"""Profiles of this session, by session_uid of the mesh object."""


def last_profile(mesh_object: bpy.types.Object) -> "FrameProfile | None":
    """Return the last profile of a mesh; None if there is none with its current number of vertices."""
    profile = _profiles.get(mesh_object.session_uid)
    return profile if profile is not None and profile.vertices == len(mesh_object.data.vertices) else None


class FDDA_OT_profile_frame(RigOperator, JobOperator, bpy.types.Operator):
    bl_idname = "fdda.profile_frame"
    bl_label = "Profile Frame"
    bl_description = (
        "Measure how much time bones, each modifier, the rest of the evaluation and drawing take in a frame, and which "
        "bones are the slowest"
    )
    bl_options = {"REGISTER"}
    verb, title = "profile_frame", "Profiling"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return cls.is_idle() and cls.has_rig(context)

    def steps(self, context: bpy.types.Context) -> Iterator[object]:
        from ..timing.frame_profile import profile_frame

        yield from profile_frame(self.rig(context))

    def finish(self, context: bpy.types.Context, result: "FrameProfile") -> str:
        _profiles[self.rig(context).mesh_object.session_uid] = result
        largest_part = max(result.parts, key=lambda part: part.duration.median)
        share = largest_part.duration.median / max(result.total, 1e-9)
        return f"{result.frame.median:.2f} ms per frame; {largest_part.title} takes {share:.0%}."


CLASSES = (FDDA_OT_profile_frame,)


def unregister() -> None:
    """Forget all profiles."""
    _profiles.clear()
