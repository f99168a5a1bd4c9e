# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws the meshes of a character: which are in the model, and why the others are not."""

import bpy

from ..scene.draw_cache import draw_cached
from ..scene.scene_rig import SceneRig, describe_left_out, left_out_meshes, rigs_of_armature
from . import findings
from .section import draw_wrapped, mesh_problem

MAX_MESHES = 24
_rigs_of_armature, _left_out_meshes = draw_cached(rigs_of_armature), draw_cached(left_out_meshes)


def draw_meshes(layout: bpy.types.UILayout, context: bpy.types.Context, rig: SceneRig, playback: bool = False) -> None:
    """Draw a line for each mesh of a character of several, with its tick, and what is left out, with the reason.

    Args:
        rig: the rig that the sidebar shows.
        playback: whether the lines have what deforms the meshes, instead of what is wrong with them.
    """
    rigs, reasons = _rigs_of_armature(rig.armature_object), _left_out_meshes(rig.armature_object)
    if len(rigs) < 2:
        return
    checked_count = sum(listed_rig.mesh_object.fdda.in_model for listed_rig in rigs)
    header, body = layout.panel("fdda_meshes_playback" if playback else "fdda_meshes", default_closed=False)
    header.label(text=f"{checked_count} of {len(rigs)} Meshes Checked")
    if body is None:
        return
    column = body.column(align=True)
    for listed_rig in rigs[:MAX_MESHES]:
        mesh_object, is_shown = listed_rig.mesh_object, listed_rig.mesh_object == rig.mesh_object
        line = column.split(factor=0.6, align=True) if playback and mesh_object.fdda.is_bound else column
        row = line.row(align=True)
        row.prop(mesh_object.fdda, "in_model", text="")
        name = row.row(align=True)
        name.alignment = "LEFT"
        icon = "RADIOBUT_ON" if is_shown else "RADIOBUT_OFF"
        name.operator("fdda.show_mesh", text=mesh_object.name, icon=icon, emboss=False).object = mesh_object.name
        is_checked = not (playback or mesh_object.fdda.is_bound)
        has_problem = is_checked and bool(mesh_problem(listed_rig) or findings.find(listed_rig))
        if not mesh_object.visible_get():
            name.label(text="", icon="HIDE_ON")
        elif mesh_object.fdda.status or has_problem:
            name.label(text="", icon="ERROR")
        elif mesh_object.fdda.is_bound:
            name.label(text="", icon="LINKED")
        if playback and mesh_object.fdda.is_bound:
            line.prop(mesh_object.fdda, "mode", text="")
    if len(rigs) > MAX_MESHES:
        column.label(text=f"and {len(rigs) - MAX_MESHES} more; select one to see it")
    if text := describe_left_out({o: reason for o, reason in reasons.items() if o.fdda.in_model}):
        draw_wrapped(column, context, text, "INFO")
    others = (r for r in rigs if r.mesh_object not in (rig.mesh_object, *reasons) and not r.mesh_object.fdda.is_bound)
    for listed_rig in () if playback else others:
        if problem := mesh_problem(listed_rig):
            draw_wrapped(column, context, f"Left out: {problem}", "ERROR")
