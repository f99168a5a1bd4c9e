# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws the profile of a frame in the section "Rig": a bar with the shares of its parts, and the slowest bones."""

from string import ascii_uppercase

import bpy

from ..jobs import job
from ..operators.frame_profile import last_profile
from ..scene.scene_rig import SceneRig
from ..timing.frame_profile import FrameProfile
from .section import draw_job, draw_wrapped

MIN_SHOWN_SHARE = 0.01
"""A part with a smaller share of the evaluation is not drawn. Drawing may take many times as long as the evaluation."""
MIN_LETTER_SHARE = 0.05
"""A segment of the bar with a smaller share has no room for its letter."""


def draw_profile(layout: bpy.types.UILayout, context: bpy.types.Context, rig: SceneRig) -> None:
    """Draw the profile of a rig, and the button that measures it or the progress of its job."""
    state, profile = job.state_of("profile_frame"), last_profile(rig.mesh_object)
    header, body = layout.panel("fdda_frame_profile", default_closed=True)
    header.label(text=f"Frame Profile ({profile.total:.1f} ms)" if profile else "Frame Profile")
    if body is None:
        return
    if state is not None and (state.is_running or state.outcome_level != "INFO"):
        draw_job(body, context, "profile_frame")
    if profile is not None:
        smallest_ms = MIN_SHOWN_SHARE * profile.frame.median
        shown = [
            (part, part.duration.median / max(profile.total, 1e-9))
            for part in profile.parts
            if part.duration.median >= smallest_ms
        ]
        letters = ascii_uppercase[: len(shown)]
        column = body.column(align=True)
        _draw_bar(column, [(letter, share) for letter, (_, share) in zip(letters, shown, strict=False)])
        for index, (part, share) in enumerate(shown):
            letter, percentage = letters[index : index + 1], f"{share:.0%}" if share >= 0.01 else "<1%"
            draw_wrapped(column, context, f"{letter}  {percentage}  {part.duration} ms  {part.title}")
        _draw_groups(body, context, profile)
        for sentence in profile.savings_sentences():
            draw_wrapped(body, context, sentence, "INFO")
    if state is None or not state.is_running:
        body.operator("fdda.profile_frame", icon="TIME").object = rig.mesh_object.name


def _draw_bar(layout: bpy.types.UILayout, segments: list[tuple[str, float]]) -> None:
    """Draw a bar of segments, each with its letter, as wide as its share; every second segment is filled."""
    remaining, rest = sum(share for _, share in segments), layout.row(align=True)
    for index, (letter, share) in enumerate(segments):
        is_last = index + 1 == len(segments)
        cell = rest if is_last else rest.split(factor=share / remaining, align=True)
        cell.progress(factor=float(index % 2 == 0), text=letter if share >= MIN_LETTER_SHARE else "")
        if not is_last:
            rest = cell.row(align=True)
        remaining -= share


def _draw_groups(layout: bpy.types.UILayout, context: bpy.types.Context, profile: "FrameProfile") -> None:
    if not profile.groups:
        return
    column = layout.column(align=True)
    column.label(text="Slowest Constraints and Drivers")
    for group in profile.groups:
        draw_wrapped(column, context, f"{group.duration.median:.2f} ms  {group.title}", "BONE_DATA")
