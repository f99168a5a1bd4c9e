# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws measured times of a character in the section "Rig", and the profile of a frame."""

from string import ascii_uppercase

import bpy

from ..jobs import job
from ..scene.scene_rig import SceneRig
from ..timing import measurements
from ..timing.benchmark import BONES, FDDA, INFERENCE, LINEAR, RIG, WITHOUT_MESHES, Benchmark
from .section import draw_job, draw_wrapped

MIN_SHOWN_SHARE = 0.01
"""A part with a smaller share of the evaluation is not drawn. Drawing may take many times as long as the evaluation."""
MIN_LETTER_SHARE = 0.05
"""A segment of the bar with a smaller share has no room for its letter."""


def draw_times(layout: bpy.types.UILayout, context: bpy.types.Context, armature_object: bpy.types.Object) -> None:
    """Draw the last times of the character of an armature, and the button that measures them or its progress."""
    times, state = measurements.last(measurements.MEASURE, armature_object), job.state_of("measure")
    if state is not None and (state.is_running or state.outcome_level != "INFO"):
        draw_job(layout, context, "measure")
    if times is not None:
        header, body = layout.panel("fdda_frame_times", default_closed=True)
        header.label(text=f"{times.median(RIG):.2f} → {times.median(FDDA):.2f} ms per Frame", icon="TIME")
        if body is not None:
            _draw_parts(body, times)
        for mesh in times.meshes if len(times.meshes) > 1 else ():
            if mesh.reason:
                draw_wrapped(layout, context, f"{mesh.name} has no model: {mesh.reason}", "ERROR")
        draw_wrapped(layout, context, times.sentence, "CHECKMARK" if times.is_worthwhile else "INFO")
    if state is None or not state.is_running:
        layout.operator("fdda.measure", text="Measure Speed", icon="TIME")


def _draw_parts(layout: bpy.types.UILayout, times: Benchmark) -> None:
    """Draw the times of a frame with the rig and with models, and what takes them."""
    if len(times.meshes) > 1:
        layout.label(text=f"{times.model_count} of {len(times.meshes)} Meshes with Models, ms per Frame")
    suffix = " (estimate)" if times.is_estimate else ""
    rows = [
        ("Rig", times.median(RIG)),
        *([("Armature Only", times.median(LINEAR))] if LINEAR in times.times else []),
        (("Model" if len(times.meshes) == 1 else "Models") + suffix, times.median(FDDA)),
        ("   Bones", times.median(BONES)),
        ("   Other Objects", max(times.median(WITHOUT_MESHES) - times.median(BONES), 0.0)),
        ("   Network", times.median(INFERENCE)),
        *((f"   Only {mesh.name}", times.median(mesh.variant)) for mesh in times.meshes if mesh.variant in times.times),
    ]
    grid = layout.column(align=True)
    for label, ms in rows:
        _draw_time(grid, label, f"{ms:.2f} ms")


def _draw_time(layout: bpy.types.UILayout, label: str, text: str) -> None:
    row = layout.split(factor=0.65)
    row.label(text=label)
    value = row.row()
    value.alignment = "RIGHT"
    value.label(text=text)


def draw_profile(layout: bpy.types.UILayout, context: bpy.types.Context, rig: SceneRig) -> None:
    """Draw the profile of a rig, and the button that measures it or the progress of its job."""
    state, profile = job.state_of("profile_frame"), measurements.last(measurements.PROFILE, rig.armature_object)
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
