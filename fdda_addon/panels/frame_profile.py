# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws the profile of a frame in the section "Rig": a bar for each part, and the slowest bones."""

from typing import TYPE_CHECKING

import bpy

from ..jobs import job
from ..operators.frame_profile import last_profile
from ..scene.scene_rig import SceneRig
from .section import draw_job, draw_wrapped

if TYPE_CHECKING:  # Blender starts without numpy.
    from ..timing.frame_profile import FrameProfile

MIN_SHOWN_SHARE = 0.01
"""A part with a smaller share of the frame is not drawn."""


def draw_profile(layout: bpy.types.UILayout, context: bpy.types.Context, rig: SceneRig) -> None:
    """Draw the profile of a rig, and the button that measures it or the progress of its job."""
    state, profile = job.state_of("profile_frame"), last_profile(rig.mesh_object)
    header, body = layout.panel("fdda_frame_profile", default_closed=True)
    header.label(text=f"Frame Profile ({profile.frame.median:.1f} ms)" if profile else "Frame Profile")
    if body is None:
        return
    if state is not None and (state.is_running or state.outcome_level != "INFO"):
        draw_job(body, context, "profile_frame")
    if profile is not None:
        _draw_parts(body, profile)
        _draw_groups(body, profile)
        for sentence in profile.savings_sentences():
            draw_wrapped(body, context, sentence, "INFO")
    if state is None or not state.is_running:
        body.operator("fdda.profile_frame", icon="TIME").object = rig.mesh_object.name


def _draw_parts(layout: bpy.types.UILayout, profile: "FrameProfile") -> None:
    column = layout.column(align=True)
    for part in profile.parts:
        share = part.duration.median / max(profile.total, 1e-9)
        if share >= MIN_SHOWN_SHARE:
            row = column.split(factor=0.5)
            row.label(text=part.title)
            row.progress(factor=share, text=f"{part.duration} ms")


def _draw_groups(layout: bpy.types.UILayout, profile: "FrameProfile") -> None:
    if not profile.groups:
        return
    column = layout.column(align=True)
    column.label(text="Slowest Constraints and Drivers")
    for group in profile.groups:
        row = column.split(factor=0.7)
        row.label(text=group.title, icon="BONE_DATA")
        row.label(text=f"{group.duration.median:.2f} ms")
