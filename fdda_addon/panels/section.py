# SPDX-License-Identifier: GPL-3.0-or-later
"""Base class of all sections of the sidebar, and functions that draw wrapped text, paths and jobs."""

import re
from collections.abc import Callable, Iterable

import blf
import bpy

from ..core.errors import RigError
from ..core.sentences.assessment import Assessment
from ..core.sentences.window import for_window
from ..jobs import job
from ..scene.active_rig import active_rig, cached_active_rig, cached_rigs_together
from ..scene.draw_cache import draw_cached
from ..scene.scene_rig import SceneRig, left_out_reason
from . import checks

TEXT_MARGIN, ICON_WIDTH = 74, 22
"""Width of both margins of a text together, and width of an icon, pixels at a UI scale of 1."""
MIN_TEXT_WIDTH = 60
USUAL_PREFIX = re.compile(r"(.*:|DEF-|CC_Base_|Bip0*1[ _])?")
"""Prefix of a bone name that says nothing about the bone: "mixamorig:", "DEF-" of Rigify."""
OUTCOME_ICONS = {"INFO": "CHECKMARK", "WARNING": "INFO", "ERROR": "ERROR"}


class Section:
    """Mixin for a panel of the tab "FDDA". It is shown if the active object has a rig, or a job of the panel runs."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "FDDA"
    verbs: tuple[str, ...] = ()
    """Verbs of the jobs that this section starts."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        running = job.current()
        return cached_active_rig(context) is not None or (running is not None and running.verb in cls.verbs)

    def enabled_layout(self) -> bpy.types.UILayout:
        """Return the layout of the panel, disabled while a job of another section changes the scene."""
        running = job.current()
        self.layout.enabled = running is None or not running.changes_scene or running.verb in self.verbs
        return self.layout

    @classmethod
    def is_done(cls, _context: bpy.types.Context) -> bool:
        """Return whether the step of this section is done, so that its header shows a check mark."""
        return False

    @classmethod
    def has_warning(cls, _context: bpy.types.Context) -> bool:
        """Return whether the result of the step has a warning, which its header then shows instead of the mark."""
        return False

    def draw_header_preset(self, context: bpy.types.Context) -> None:
        if self.is_done(context):
            self.layout.label(text="", icon="ERROR" if self.has_warning(context) else "CHECKMARK")
        self.layout.operator("fdda.help", text="", icon="QUESTION", emboss=False).section = self.bl_label


def panel_rig(context: bpy.types.Context) -> tuple[SceneRig | None, str]:
    """Return the rig that the sidebar shows and an empty text, or None and an error message."""
    if (rig := cached_active_rig(context)) is not None:
        return rig, ""
    try:
        return active_rig(context), ""
    except RigError as error:
        return None, str(error)


def draw_button(
    layout: bpy.types.UILayout,
    context: bpy.types.Context,
    name: str,
    text: str,
    icon: str,
    applies_to: Callable[[SceneRig], bool] = lambda _: True,
) -> bpy.types.OperatorProperties:
    """Draw the button of an operator that may apply to several meshes; its text then has their number.

    Args:
        applies_to: whether the operator applies to a checked mesh.
    """
    rigs = cached_rigs_together(context)
    count = sum(map(applies_to, rigs))
    properties = layout.operator(name, text=f"{text} ({count} Meshes)" if count > 1 else text, icon=icon)
    properties.all_meshes = bool(rigs)
    return properties


def mesh_problem(rig: SceneRig) -> str:
    """Return why a mesh cannot be recorded with others, at its last check; empty without a reason."""
    check = checks.last_check(rig)
    return next(iter(check.problems_beside_others), "") if check is not None else ""


def is_recordable(rig: SceneRig) -> bool:
    """Return whether a recording of all checked meshes has a mesh."""
    # What is bound was recorded; a check while the user poses would cost time.
    return not left_out_reason(rig.mesh_object) and (is_bound(rig) or not mesh_problem(rig))


def is_bound(rig: SceneRig) -> bool:
    """Return whether a model is bound to a mesh."""
    return rig.mesh_object.fdda.is_bound


def draw_wrapped(layout: bpy.types.UILayout, context: bpy.types.Context, text: str, icon: str = "NONE") -> None:
    """Draw text, wrapped to the width of the sidebar."""
    scale, points = _text_size(context.preferences)
    width = context.region.width - (TEXT_MARGIN + (ICON_WIDTH if icon != "NONE" else 0)) * scale
    lines = _wrap(text, max(width, MIN_TEXT_WIDTH * scale), points)
    if len(lines) == 1:
        layout.label(text=lines[0], icon=icon)
        return
    column = layout.column(align=True)
    column.scale_y = 0.8
    for index, line in enumerate(lines):
        column.label(text=line, icon=icon if index == 0 else ("BLANK1" if icon != "NONE" else "NONE"))


@draw_cached
def _text_size(preferences: bpy.types.Preferences) -> tuple[float, float]:
    """Return the UI scale, and the height of text in points."""
    scale = preferences.system.ui_scale
    return scale, preferences.ui_styles[0].widget.points * scale


@draw_cached
def _wrap(text: str, width: float, points: float) -> tuple[str, ...]:
    """Wrap text to a width in pixels, in the font of the interface, without breaking long words."""
    blf.size(0, points)
    lines: list[str] = []
    for word in for_window(text).split():
        if lines and blf.dimensions(0, f"{lines[-1]} {word}")[0] <= width:
            lines[-1] += f" {word}"
        else:
            lines.append(word)
    return tuple(lines)


def draw_assessment(layout: bpy.types.UILayout, context: bpy.types.Context, assessment: Assessment) -> None:
    """Draw what errors mean, with the warnings."""
    draw_wrapped(layout, context, assessment.sentence, "CHECKMARK" if assessment.is_good else "ERROR")
    for warning in assessment.warnings:
        draw_wrapped(layout, context, warning, "BLANK1")


def draw_table_row(layout: bpy.types.UILayout, texts: Iterable[str]) -> bpy.types.UILayout:
    """Draw a row of a table with right-aligned texts, and return the layout for the name before them."""
    row = layout.split(factor=0.4, align=True)
    name = row.row(align=True)
    name.alignment = "LEFT"
    for text in texts:
        cell = row.row(align=True)
        cell.alignment = "RIGHT"
        cell.label(text=text)
    return name


def short_bone_name(name: str) -> str:
    """Return the name of a bone for narrow tables, without a namespace or a usual prefix."""
    return name[USUAL_PREFIX.match(name).end() :] or name


def draw_path(layout: bpy.types.UILayout, owner: bpy.types.bpy_struct, name: str, default: str) -> None:
    """Draw a path below its label, at full width. An empty path shows the default in gray."""
    column = layout.column(align=True)
    column.label(text=owner.bl_rna.properties[name].name)
    column.prop(owner, name, text="", placeholder=default)


def draw_advanced(layout: bpy.types.UILayout, identifier: str) -> bpy.types.UILayout | None:
    """Draw the sub-panel "Advanced", closed by default; return the column for its fields, None if it is closed."""
    header, body = layout.panel(identifier, default_closed=True)
    header.label(text="Advanced")
    if body is None:
        return None
    column = body.column()
    column.use_property_split, column.use_property_decorate = True, False
    return column


def draw_job(
    layout: bpy.types.UILayout,
    context: bpy.types.Context,
    verb: str,
    levels: tuple[str, ...] = ("INFO", "WARNING", "ERROR"),
) -> bool:
    """Draw the progress of a job with a button to cancel it, or its outcome.

    Args:
        layout, context: layout and context of the panel.
        verb: verb of the job.
        levels: outcomes of other levels are not drawn.

    Returns:
        Whether the job is running.
    """
    state = job.state_of(verb)
    if state is None:
        return False
    if not state.is_running:
        rig = panel_rig(context)[0]
        shown_rigs = cached_rigs_together(context) or ((rig,) if rig is not None else ())
        is_shown = not state.subject or any(each.mesh_object.session_uid == state.subject for each in shown_rigs)
        if is_shown and state.outcome_level in levels:
            draw_wrapped(layout, context, state.outcome, OUTCOME_ICONS[state.outcome_level])
        return False
    column = layout.column(align=True)
    if state.total or state.steps:
        # The text of a progress bar is cut off at the default width, so the bar has the short one.
        column.progress(factor=state.fraction, text=state.heading)
        draw_wrapped(column, context, state.detail)
    else:
        # A progress bar that stays at 0 would look as if the job did nothing.
        draw_wrapped(column, context, state.sentence, "SORTTIME")
    row = column.row(align=True)
    row.enabled = not state.cancel_requested
    row.operator("fdda.cancel", text="Canceling…" if state.cancel_requested else "Cancel", icon="X")
    # This line is always drawn, so that the elements below it do not move.
    layout.label(text=state.remaining_text, icon="TIME")
    if state.note:
        draw_wrapped(layout, context, state.note, "ERROR")
    return True
