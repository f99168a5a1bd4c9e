# SPDX-License-Identifier: GPL-3.0-or-later
"""Section "Training": shows the setup, the settings, the error curves, and the errors of the trained model."""

import os
from pathlib import Path

import bpy

from ..core.errors import TrainingError
from ..core.formats.report import Verdict, checkpoint_path, read_report, report_path
from ..core.sentences.assessment import Assessment, assess_training
from ..jobs import job
from ..jobs.state import JobState
from ..properties.character import default_model
from ..properties.preferences import MODULE, preferences
from ..scene.draw_cache import computed_once
from ..scene.scene_rig import SceneRig
from ..training.environment import choice, session
from . import curves
from .recording import has_recording, is_in_recording, read_content
from .section import (
    Section,
    draw_advanced,
    draw_assessment,
    draw_button,
    draw_job,
    draw_path,
    draw_table_row,
    draw_wrapped,
    panel_rig,
    short_bone_name,
)
from .trained_file import TrainedFile, find_trained_file

SHOWN_PARTITIONS = 8
TRAINING_VERBS = ("train", "build_model")


class FDDA_PT_training(Section, bpy.types.Panel):
    bl_idname = "FDDA_PT_training"
    bl_label = "Training"
    bl_options = {"DEFAULT_CLOSED"}
    verbs = ("train", "refine")

    @classmethod
    def is_done(cls, context: bpy.types.Context) -> bool:
        rig = panel_rig(context)[0]
        running_job = job.current()
        if rig is None or (running_job and running_job.verb == "train"):
            return False
        trained = find_trained_file(rig)
        return trained is not None and not trained.mismatch

    @classmethod
    def has_warning(cls, context: bpy.types.Context) -> bool:
        rig = panel_rig(context)[0]
        trained = find_trained_file(rig) if rig is not None else None
        assessment = read_assessment(trained.path) if trained is not None else None
        return assessment is not None and not assessment.is_good

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.enabled_layout()
        running_job = job.current()
        if running_job and running_job.verb == "train":
            draw_job(layout, context, "train")
            curves.draw(layout, running_job.curves)
            for warning in running_job.warnings:
                draw_wrapped(layout, context, warning, "INFO")
            draw_wrapped(layout, context, "You can keep working, or even quit Blender: training continues.", "INFO")
            return
        if running_job and running_job.verb == "refine":
            draw_job(layout, context, "refine")
            draw_wrapped(layout, context, "ESC cancels as well; the poses that were added are kept.", "INFO")
            return
        rig = panel_rig(context)[0]
        if rig is None:
            return
        can_train = _draw_python(layout, context)
        trained = find_trained_file(rig)
        _draw_settings(layout, context, rig, trained, can_train)
        draw_job(layout, context, "refine")
        draw_job(layout, context, "train")
        if (state := _last_training(rig)) is not None:
            curves.draw(layout, state.curves)
        if trained is not None and not trained.mismatch:
            _draw_assessment(layout, context, rig, trained)
            # Draw the buttons that follow a training: the model is bound, or improved.
            if not rig.mesh_object.fdda.is_bound:
                row = layout.row()
                row.scale_y = 1.3
                bind = row.operator("fdda.bind", text=f"Bind {trained.path.stem}", icon="LINKED")
                bind.object, bind.filepath = rig.mesh_object.name, str(trained.path)
            improve = layout.column(align=True)
            improve.enabled = can_train
            improve.operator("fdda.refine", text="Add Poses at Worst Errors", icon="ADD")
            if checkpoint_path(trained.path).is_file():
                improve.operator("fdda.train", text="Continue Training", icon="FF").warm_start = True
            else:
                draw_wrapped(layout, context, "Its checkpoint is missing, so training cannot continue from it.", "INFO")
            _draw_report(layout, context, rig, trained.path)
        if (advanced := draw_advanced(layout, "fdda_training_advanced")) is not None:
            settings = rig.mesh_object.fdda.settings
            # The labels are above the fields, because a narrow sidebar would cut them off beside the fields.
            for name in ("base_skinning", "bones_to_read", "min_vertices_per_part"):
                field = advanced.column(align=True)
                field.use_property_split = False
                field.label(text=settings.bl_rna.properties[name].name)
                field.prop(settings, name, text="")
                if name == "bones_to_read" and settings.bones_to_read == "NUMBER":
                    field.prop(settings, "bone_count")
            for name in ("passes", "detail_mm", "training_seed"):
                advanced.prop(settings, name)
            draw_path(advanced, settings, "model", default_model(rig.mesh_object))


def _has_succeeded(state: JobState | None) -> bool:
    return state is not None and not state.is_running and state.outcome_level == "INFO"


def _last_training(rig: SceneRig) -> JobState | None:
    """Return the state of the last job that has trained a model of a rig and has its curves; None without one."""
    mesh_object, states = rig.mesh_object, [job.state_of(verb) for verb in TRAINING_VERBS]
    states = [
        state
        for state in states
        if state is not None and not state.is_running and state.subject == mesh_object.session_uid
    ]
    return max(states, key=lambda state: state.ended, default=None)


def _draw_python(layout: bpy.types.UILayout, context: bpy.types.Context) -> bool:
    """Draw the Python for training and the result of its check; return whether training may be tried."""
    result = session.check_result
    if result is not None and result.level == "INFO":
        draw_wrapped(layout, context, result.message, "CHECKMARK")
        return True
    if result is None and any(_has_succeeded(job.state_of(verb)) for verb in TRAINING_VERBS):
        return True
    box = layout.box()
    if (running_check := job.current(job.ENVIRONMENT)) is not None:
        draw_wrapped(box, context, f"{running_check.title}: {running_check.stage}", "SORTTIME")
    elif result is not None:
        draw_wrapped(box, context, result.message, "ERROR" if result.level == "ERROR" else "INFO")
    elif choice.select_python().origin is choice.Origin.THIS:
        text = "Training needs PyTorch, which is not installed yet; install it in the preferences."
        draw_wrapped(box, context, text, "ERROR")
    else:
        draw_wrapped(box, context, f"Python not checked yet: {choice.select_python().path}", "INFO")
    row = box.row(align=True)
    row.operator("fdda.check_trainer", text="Check Setup", icon="VIEWZOOM")
    if preferences() is not None:
        row.operator("preferences.addon_show", text="Preferences", icon="PREFERENCES").module = MODULE
    return result is None or result.level != "ERROR"


def _draw_settings(
    layout: bpy.types.UILayout, context: bpy.types.Context, rig: SceneRig, trained: TrainedFile | None, can_train: bool
) -> None:
    settings = rig.mesh_object.fdda.settings
    column = layout.column()
    column.use_property_split = True
    column.use_property_decorate = False
    row = column.row(heading="Goal (mm)")
    row.prop(settings, "use_goal", text="")
    goal = row.row()
    goal.active = settings.use_goal
    goal.prop(settings, "goal_mm", text="")
    content, is_recorded = read_content(rig), has_recording(rig)
    row = layout.row()
    row.enabled = can_train and is_recorded
    row.scale_y = 1.3
    text = "Train" if trained is None else "Train Again"
    draw_button(row, context, "fdda.train", text, "PLAY", lambda each: each == rig or is_in_recording(each, rig))
    if isinstance(content, str):
        draw_wrapped(layout, context, content, "ERROR")
    elif not is_recorded:
        draw_wrapped(layout, context, "This rig has no complete recording yet; record first.", "INFO")
    if trained is not None and trained.mismatch:
        mismatch = trained.mismatch.rstrip(".")
        text = f"{trained.path.name} does not fit this rig: {mismatch}. Train keeps it as the previous model."
        draw_wrapped(layout, context, text, "ERROR")
    elif trained is not None:
        draw_wrapped(layout, context, f"{trained.path.name} exists; Train Again keeps it as the previous model.")


def _draw_assessment(
    layout: bpy.types.UILayout, context: bpy.types.Context, rig: SceneRig, trained: TrainedFile
) -> None:
    """Draw what the errors of the training mean, what its skin weights and key joints are, and what to do next."""
    report = _read_report(trained.path)
    if report is None:
        return
    box, assessment = layout.box(), read_assessment(trained.path)
    draw_assessment(box, context, assessment)
    if goal := report.get("goal"):
        draw_wrapped(box, context, *_describe_goal(goal))
    if assessment.next_step:
        is_bound = rig.mesh_object.fdda.is_bound
        text = "Next: compare it with the rig on an action." if is_bound else assessment.next_step
        draw_wrapped(box, context, text, "BLANK1")
    if trained.skin_sentence:
        draw_wrapped(box, context, trained.skin_sentence, "BLANK1")
    if warnings := report.get("warnings"):
        header, body = layout.panel("fdda_recording_warnings", default_closed=True)
        header.label(text=f"Recording Warnings ({len(warnings)})", icon="INFO")
        for warning in warnings if body is not None else ():
            draw_wrapped(body, context, warning["text"], "DOT")


def read_assessment(model: Path) -> Assessment | None:
    """Return what the report of a model means; None without a report. It is computed once for each report."""
    report = _read_report(model)
    return report and computed_once(("assessment", model), (report,), lambda: assess_training(report))


def recording_warnings(rig: SceneRig, model_name: str) -> list[dict]:
    """Return the warnings about the recording of a model, if it is the trained model of a rig with this name."""
    trained = find_trained_file(rig)
    report = _read_report(trained.path) if trained is not None and trained.path.stem == model_name else None
    return report.get("warnings", []) if report else []


def _draw_report(layout: bpy.types.UILayout, context: bpy.types.Context, rig: SceneRig, model: Path) -> None:
    report = _read_report(model)
    if report is None:
        return
    header, body = layout.panel("fdda_held_out", default_closed=True)
    header.label(text="Error by Body Part")
    if body is None:
        return
    partitions = sorted(report["partitions"], key=lambda partition: -partition["held_out"]["max"])
    shown_partitions = partitions if context.window_manager.fdda.show_all_partitions else partitions[:SHOWN_PARTITIONS]
    table = body.box().column(align=True)
    draw_table_row(table, ("Mean", "99.9 %", "Max")).label(text="Body Part")
    for partition in shown_partitions:
        errors = partition["held_out"]
        texts = f"{errors['mean']:.3f}", f"{errors['p999']:.2f}", f"{errors['max']:.2f}"
        draw_table_row(table, texts).label(text=short_bone_name(partition["joint"]))
    if len(partitions) > SHOWN_PARTITIONS:
        text = f"Show All {len(partitions)} Body Parts"
        body.prop(context.window_manager.fdda, "show_all_partitions", text=text, toggle=True)


def _describe_goal(goal: dict) -> tuple[str, str]:
    """Return a sentence and an icon about the accuracy goal in a report."""
    reached = f"99.9 % of points within {goal['p999']:.2f} mm, goal {goal['goal']:g} mm"
    return {
        Verdict.MET: (f"{reached}: met.", "CHECKMARK"),
        Verdict.MISSED: (f"{reached}: missed. Add poses at the worst errors, and continue training.", "INFO"),
        Verdict.EXHAUSTED: (f"{reached}: missed, and more poses no longer help.", "INFO"),
    }[Verdict(goal["verdict"])]


def _read_report(model: Path) -> dict | None:
    """Return the training report of a model, None without a valid one. It is read again after a change of the file."""
    path = report_path(model)
    try:
        modified_ns = os.stat(path).st_mtime_ns
    except OSError:
        return None
    return computed_once(("report", model), (modified_ns,), lambda: _valid_report(path, model.name))


def _valid_report(path: Path, model_name: str) -> dict | None:
    try:
        report = read_report(path)
    except TrainingError:
        return None
    return report if report["model"] == model_name else None


CLASSES = (FDDA_PT_training,)


def unregister() -> None:
    """Free the image of the curves."""
    curves.image.release()
