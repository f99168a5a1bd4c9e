# SPDX-License-Identifier: GPL-3.0-or-later
"""Section "Training": which Python trains, the curves while it does, and the partitions when it has."""

import json
import os
from pathlib import Path

import bpy

from ..core.errors import FDDAError
from ..core.messages import WARNING
from ..operators import job
from ..preferences import MODULE, preferences
from ..scene.scene_rig import SceneRig
from ..settings import model_file, recording_folder
from ..trainer_environment import choice, session
from . import curves
from .recording import content_of
from .section import Section, draw_job, draw_path, draw_sentence, panel_rig

REPORT = "report.json"
WEIGHTS = ".weights.npz"
"""Ending of the file of a model's last weights, beside it."""
UNITS = {"probes": "poses compared", "poses": "poses added"}
SHOWN_PARTITIONS = 8

_reports: dict[Path, tuple[int, dict | None]] = {}
"""Reports that were read, by path, with the time of their change."""


class FDDA_PT_training(Section, bpy.types.Panel):
    bl_idname = "FDDA_PT_training"
    bl_label = "Training"
    verbs = ("train", "refine")

    @classmethod
    def is_done(cls, context: bpy.types.Context) -> bool:
        rig = panel_rig(context)[0]
        running = job.current()
        if rig is None or (running and running.verb == "train"):
            return False
        try:
            return model_file(rig.mesh_object).is_file()
        except FDDAError:
            return False

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.usable_layout()
        running = job.current()
        if running and running.verb == "train":
            draw_job(layout, context, "train", "epochs")
            if not running.total:
                draw_sentence(layout, context, "The trainer starts and reads the recording.")
            curves.draw(layout, running.curves)
            for line in running.log:
                if line.startswith(WARNING):
                    draw_sentence(layout, context, line, "INFO")
            draw_sentence(layout, context, "You can go on working meanwhile.", "INFO")
            return
        if running and running.verb == "refine":
            draw_job(layout, context, "refine", UNITS.get(running.stage, running.stage))
            draw_sentence(layout, context, "ESC cancels as well; the poses that were added are kept.", "INFO")
            return
        rig = panel_rig(context)[0]
        if rig is None:
            return
        ready = _draw_python(layout, context)
        _draw_settings(layout, context, rig, ready)
        draw_job(layout, context, "refine", "poses")
        draw_job(layout, context, "train", "epochs")
        ended = job.state_of("train")
        if ended is not None and ended.subject == rig.mesh_object.name:
            curves.draw(layout, ended.curves)
        _draw_report(layout, context, rig)


def _draw_python(layout: bpy.types.UILayout, context: bpy.types.Context) -> bool:
    """Which Python trains and what is known of it; returns whether it may be tried."""
    answer = session.answer
    if answer is not None and answer.level == "INFO":
        draw_sentence(layout, context, answer.message, "CHECKMARK")
        return True
    box = layout.box()
    if session.task is not None:
        draw_sentence(box, context, f"{session.task.title}: {session.task.progress.stage}", "SORTTIME")
    elif answer is not None:
        draw_sentence(box, context, answer.message, "ERROR" if answer.level == "ERROR" else "INFO")
    elif choice.chosen_python().origin is choice.Origin.THIS:
        text = "Training needs a Python with PyTorch, and there is none yet; the preferences can make one."
        draw_sentence(box, context, text, "ERROR")
    else:
        draw_sentence(box, context, f"Trains with {choice.chosen_python().path}, which was not checked yet.", "INFO")
    row = box.row(align=True)
    row.operator("fdda.check_trainer", text="Check", icon="QUESTION")
    if preferences() is not None:
        row.operator("preferences.addon_show", text="Preferences", icon="PREFERENCES").module = MODULE
    return answer is None or answer.level != "ERROR"


def _draw_settings(layout: bpy.types.UILayout, context: bpy.types.Context, rig: SceneRig, ready: bool) -> None:
    from ..core.recording_folder import FolderState

    settings = rig.mesh_object.fdda.settings
    column = layout.column()
    column.use_property_split = True
    column.use_property_decorate = False
    column.prop(settings, "target_mm")
    column.prop(settings, "tolerance_mm")
    column.prop(settings, "epochs")
    column.prop(settings, "training_seed")
    draw_path(layout, settings, "model")
    try:
        model = model_file(rig.mesh_object)
        recording = recording_folder(rig.mesh_object)
        content = content_of(rig, recording)
    except FDDAError as error:
        draw_sentence(layout, context, str(error), "ERROR")
        ready, model = False, None
    else:
        if content.state is not FolderState.COMPLETE:
            draw_sentence(layout, context, "There is no complete recording of this rig yet; record first.", "INFO")
            ready = False
        elif model.is_file():
            draw_sentence(layout, context, f"'{model.name}' is there; training again replaces it.", "CHECKMARK")
    row = layout.row()
    row.enabled = ready
    row.scale_y = 1.3
    row.operator("fdda.train", text="Train", icon="PLAY")
    if model is not None and model.is_file():
        # What a better model takes, in the order of the work.
        on = layout.column(align=True)
        on.enabled = ready
        on.operator("fdda.refine", text="Add Poses Where It Is Worst", icon="ADD")
        train = on.row(align=True)
        train.enabled = model.with_suffix(WEIGHTS).is_file()
        train.operator("fdda.train", text="Train On", icon="FF").warm_start = True
    if model is not None and model.is_file() and not rig.mesh_object.fdda.is_bound:
        bind = layout.operator("fdda.bind", text=f"Bind '{model.name}'", icon="LINKED")
        bind.object, bind.filepath = rig.mesh_object.name, str(model)


def _draw_report(layout: bpy.types.UILayout, context: bpy.types.Context, rig: SceneRig) -> None:
    try:
        model = model_file(rig.mesh_object)
    except FDDAError:
        return
    report = _report(model.with_name(REPORT))
    if report is None or report["model"] != model.name:
        return
    if target := report.get("target"):
        draw_sentence(layout, context, *_target(target))
    for warning in report.get("warnings", ()):
        draw_sentence(layout, context, f"Warning: {warning['name']}; the report says what to do.", "INFO")
    everything = report["fdda"]["held_out"]
    layout.label(text="Held-out error in mm, worst first")
    table = layout.box().column(align=True)
    _draw_row(table, ("Partition", "Shapes", "Mean", "Max"))
    partitions = sorted(report["partitions"], key=lambda p: -p["held_out"]["max"])
    shown = partitions if context.window_manager.fdda.show_all_partitions else partitions[:SHOWN_PARTITIONS]
    for p in shown:
        _draw_row(table, (p["joint"], str(p["basis"]), f"{p['held_out']['mean']:.3f}", f"{p['held_out']['max']:.2f}"))
    shapes = str(sum(p["basis"] for p in partitions))
    _draw_row(table, ("All", shapes, f"{everything['mean']:.3f}", f"{everything['max']:.2f}"))
    if len(partitions) > SHOWN_PARTITIONS:
        text = f"Show All {len(partitions)} Partitions"
        layout.prop(context.window_manager.fdda, "show_all_partitions", text=text, toggle=True)


def _target(target: dict) -> tuple[str, str]:
    """A sentence and an icon for what the report says of the target."""
    reached = f"99.9 % within {target['p999']:.2f} mm, target {target['target']:g} mm"
    return {
        "met": (f"{reached}: met.", "CHECKMARK"),
        "missed": (f"{reached}: missed. Add poses where the model is worst, and train on.", "INFO"),
        "exhausted": (f"{reached}: missed, and more poses no longer help.", "INFO"),
    }[target["verdict"]]


def _draw_row(table: bpy.types.UILayout, cells: tuple[str, str, str, str]) -> None:
    rest = table
    for cell, factor in zip(cells, (0.36, 0.38, 0.5), strict=False):
        rest = rest.split(factor=factor)
        own = rest.row()
        own.alignment = "LEFT" if cell is cells[0] else "RIGHT"
        own.label(text=cell)
    rest.alignment = "RIGHT"
    rest.label(text=cells[-1])


def _report(path: Path) -> dict | None:
    """The report beside a model, read again when it has changed; None when there is none that can be drawn."""
    try:
        stamp = os.stat(path).st_mtime_ns
    except OSError:
        return None
    if path not in _reports or _reports[path][0] != stamp:
        try:
            report = json.loads(path.read_text(encoding="utf-8"))
            for errors in (report["fdda"], *report["partitions"]):
                float(errors["held_out"]["mean"]), float(errors["held_out"]["max"])
            for partition in report["partitions"]:
                str(partition["joint"]), int(partition["basis"])
            str(report["model"])
            for warning in report.get("warnings", ()):
                str(warning["name"])
            if target := report.get("target"):
                _target(target)
        except (OSError, ValueError, KeyError, TypeError):
            report = None
        _reports[path] = (stamp, report)
    return _reports[path][1]


CLASSES = (FDDA_PT_training,)


def unregister() -> None:
    """Let go of the picture of the curves."""
    curves.release()
