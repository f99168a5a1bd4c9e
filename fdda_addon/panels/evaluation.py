# SPDX-License-Identifier: GPL-3.0-or-later
"""Section "Compare with Rig": shows the errors of the model as numbers and colors, and the worst frames."""

import bpy

from ..core.sentences.assessment import Assessment, PartErrors, assess_evaluation
from ..core.wording import format_count
from ..evaluation import heat_map, last_evaluation, side_by_side
from ..jobs import job
from ..models.model_list import bound_model_name
from ..scene.active_rig import cached_rigs_together
from ..scene.scene_rig import SceneRig
from .section import (
    Section,
    draw_assessment,
    draw_button,
    draw_job,
    draw_table_row,
    draw_wrapped,
    is_bound,
    panel_rig,
    short_bone_name,
)
from .training import recording_warnings

SHOWN_PARTITIONS, SHOWN_POSES = 5, 5
STATISTICS = (("Mean", "mean"), ("99.9 %", "p999"), ("Max", "max"))


class FDDA_PT_evaluation(Section, bpy.types.Panel):
    bl_idname = "FDDA_PT_evaluation"
    bl_label = "Compare with Rig"
    bl_options = {"DEFAULT_CLOSED"}
    verbs = ("evaluate", "render_comparison")

    @classmethod
    def is_done(cls, context: bpy.types.Context) -> bool:
        rig = panel_rig(context)[0]
        return rig is not None and last_evaluation.get(rig.mesh_object) is not None

    @classmethod
    def has_warning(cls, context: bpy.types.Context) -> bool:
        rig = panel_rig(context)[0]
        return not _assess(rig, last_evaluation.get(rig.mesh_object)).is_good

    def draw(self, context: bpy.types.Context) -> None:
        layout, view = self.enabled_layout(), context.window_manager.fdda_view
        scene_rig, reason = panel_rig(context)
        if scene_rig is None:
            draw_wrapped(layout, context, reason, "INFO")
            return
        if not scene_rig.mesh_object.fdda.is_bound:
            draw_wrapped(layout, context, "Bind a model first, to compare it with the rig.", "INFO")
        elif scene_rig.mesh_object.fdda.is_fast_rig:
            draw_wrapped(layout, context, "This is a fast rig: compare the model in the file of the full rig.", "INFO")
        else:
            column = layout.column(align=True)
            column.label(text="Show the Rig")
            row = column.row(align=True)
            current_placement = side_by_side.display_mode(scene_rig.mesh_object)
            for placement, text in (("NONE", "Off"), ("BESIDE", "Beside"), ("OVERLAY", "Overlay")):
                button = row.operator("fdda.show_rig", text=text, depress=current_placement == placement)
                button.placement = placement
                button.all_meshes = bool(cached_rigs_together(context))
            self._draw_evaluate(context, scene_rig)
        last = last_evaluation.get(scene_rig.mesh_object)
        if last is not None:
            _draw_statistics(layout, context, view, last, scene_rig)
        _draw_colors(layout, context, view, scene_rig.mesh_object, last)
        if last is not None:
            _draw_worst(layout, view, last)
        if scene_rig.mesh_object.fdda.is_bound:
            if not scene_rig.mesh_object.fdda.is_fast_rig:
                state = job.state_of("render_comparison")
                if state is None or not state.is_running:
                    layout.operator("fdda.render_comparison", text="Render Comparison…", icon="RENDER_ANIMATION")
                if state is not None:
                    draw_job(layout, context, "render_comparison")
            layout.operator("fdda.open_report", icon="URL")

    def _draw_evaluate(self, context: bpy.types.Context, scene_rig: object) -> None:
        layout, view = self.enabled_layout(), context.window_manager.fdda_view
        state = job.state_of("evaluate")
        if state is not None and state.is_running:
            draw_job(layout, context, "evaluate")
            return
        source_column = layout.column(align=True)
        source_column.label(text="Compare On")
        source_column.row(align=True).prop(view, "source", expand=True)
        column = layout.column()
        column.use_property_split, column.use_property_decorate = True, False
        action = bpy.data.actions.get(view.action)
        if view.source == "RANDOM":
            column.prop(view, "poses")
            column.prop(view, "seed")
        else:
            layout.prop(view, "action", text="", icon="ACTION", placeholder="Choose an Action")
            text = "No action is active"
            if action is not None:
                first_frame, last_frame = (round(frame) for frame in action.frame_range)
                text = f"Frames {first_frame} to {last_frame}"
            layout.label(text=text, icon="TIME")
        row = layout.row()
        row.scale_y = 1.4
        row.enabled = view.source == "RANDOM" or action is not None
        button = draw_button(row, context, "fdda.evaluate", "Evaluate", "PLAY", is_bound)
        button.source, button.poses, button.seed = view.source, view.poses, view.seed
        if state is not None and state.outcome_level != "INFO":
            draw_job(layout, context, "evaluate")


def _draw_statistics(
    layout: bpy.types.UILayout,
    context: bpy.types.Context,
    view: object,
    last: last_evaluation.LastEvaluation,
    rig: SceneRig,
) -> None:
    frames_text = f"{format_count(last.poses, 'frame')} of {last.name}"
    poses_text = frames_text if last.name else format_count(last.poses, "random pose")
    header, body = layout.panel("fdda_figures", default_closed=False)
    header.label(text="Error (mm)")
    if body is None:
        return
    draw_wrapped(body, context, f"{last.model} on {poses_text}")
    table = body.column(align=True)
    draw_table_row(table, [label for label, _ in STATISTICS]).label(text="")
    for label, method in (("Model", "fdda"), ("Skinning", "linear")):
        texts = [_format_mm(getattr(last.total[method], name)) for _, name in STATISTICS]
        draw_table_row(table, texts).label(text=label)
    assessment = _assess(rig, last)
    draw_assessment(body, context, assessment)
    if assessment.next_step:
        draw_wrapped(body, context, assessment.next_step, "BLANK1")
    body.separator()
    row = body.row()
    row.label(text="Worst Body Parts")
    if len(last.partitions) > SHOWN_PARTITIONS:
        row.prop(view, "show_partitions", text="All", toggle=True)
    active = active_bone_name(context, rig)
    active_partitions = [partition for partition in last.partitions if partition.joint == active]
    if context.mode == "POSE" and not active_partitions:
        draw_wrapped(
            body, context, "Click a bone to see its body part on top; click a name to select its bone.", "INFO"
        )
    shown_partitions = last.partitions[: None if view.show_partitions else SHOWN_PARTITIONS]
    column = body.column(align=True)
    for partition in (*active_partitions, *(p for p in shown_partitions if p not in active_partitions)):
        name = draw_table_row(column, [_format_mm(getattr(partition.fdda, statistic)) for _, statistic in STATISTICS])
        text = short_bone_name(partition.joint)
        icon = "BONE_DATA" if partition.joint == active else "NONE"
        name.operator("fdda.show_bone", text=text, icon=icon, emboss=False).bone = partition.joint


def _assess(rig: SceneRig, last: last_evaluation.LastEvaluation) -> Assessment:
    """Return what the errors of the last evaluation of a mesh mean."""
    parts = [PartErrors(p.joint, p.fdda.mean, p.linear.mean) for p in last.partitions]
    return assess_evaluation(
        last.total["fdda"],
        last.total["linear"],
        rig.mesh_object.name,
        parts,
        recording_warnings(rig, last.model),
        bound_model_name(rig.mesh_object) == last.model,
    )


def active_bone_name(context: bpy.types.Context, rig: SceneRig) -> str:
    """Return the name of the active bone in Pose Mode; empty in other modes."""
    bone = rig.armature_object.data.bones.active if context.mode == "POSE" else None
    return bone.name if bone is not None else ""


def _draw_colors(
    layout: bpy.types.UILayout,
    context: bpy.types.Context,
    view: object,
    mesh_object: bpy.types.Object,
    last: last_evaluation.LastEvaluation | None,
) -> None:
    header, body = layout.panel("fdda_colors", default_closed=False)
    header.label(text="Viewport Colors")
    if body is None:
        return
    painted_colors = heat_map.paint_kind(mesh_object)
    row = body.row(align=True)
    for colors, text in (("NONE", "None"), ("ERRORS", "Heat Map"), ("PARTITIONS", "Body Parts")):
        button = row.row(align=True)
        button.enabled = colors != "ERRORS" or last is not None
        button.operator(
            "fdda.color_mesh", text=text, depress=painted_colors == ("" if colors == "NONE" else colors)
        ).colors = colors
    if last is None:
        draw_wrapped(body, context, "Press Evaluate to get the heat map.", "INFO")
    if painted_colors and heat_map.is_hidden(mesh_object):
        text = "Colors are hidden in Edit Mode, and while a modifier changes the topology in the viewport."
        draw_wrapped(body, context, text, "INFO")
    if painted_colors != "ERRORS" or last is None:
        return
    column = body.column(align=True)
    column.row(align=True).prop(view, "deformation", expand=True)
    column.row(align=True).prop(view, "statistic", expand=True)
    if view.statistic == "pose" and not last.name and view.pose < 0:
        draw_wrapped(body, context, "Click a pose below to see its errors.", "INFO")
    elif view.statistic == "pose" and last.name and last.pose_at(context.scene.frame_current) is None:
        draw_wrapped(body, context, f"Frame {context.scene.frame_current} was not compared.", "INFO")
    row = body.row(align=True)
    row.prop(view, "range_mm")
    row.operator("fdda.fit_color_range", text="", icon="FULLSCREEN_EXIT")


def _draw_worst(layout: bpy.types.UILayout, view: object, last: last_evaluation.LastEvaluation) -> None:
    header, body = layout.panel("fdda_worst", default_closed=False)
    header.label(text="Worst Frames" if last.name else "Worst Poses")
    if body is None:
        return
    column = body.column(align=True)
    for rank, (index, error_mm) in enumerate(last.worst_poses(SHOWN_POSES), 1):
        pose_label = f"Frame {round(last.scene_frame(index))}" if last.name else f"Pose {index + 1}"
        row = column.row(align=True)
        row.operator("fdda.jump_to_worst", text=f"{pose_label}: {error_mm:.2f} mm").rank = rank
        zoom_button = row.operator("fdda.jump_to_worst", text="", icon="ZOOM_SELECTED")
        zoom_button.rank, zoom_button.zoom = rank, True
    if last.name:
        body.prop(view, "graph")


def _format_mm(value: float) -> str:
    return f"{value:.2f}" if value < 10 else f"{value:.1f}"


CLASSES = (FDDA_PT_evaluation,)
