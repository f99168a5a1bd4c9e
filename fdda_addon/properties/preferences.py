# SPDX-License-Identifier: GPL-3.0-or-later
"""The add-on's preferences: which Python trains, and the environment that the add-on can make for it."""

import os
from pathlib import Path

import bpy
from bpy.props import BoolProperty, CollectionProperty, StringProperty

from ..jobs.job import ENVIRONMENT, JobState, current
from ..scene import folder_trust
from ..training.environment import choice, session
from ..training.environment.check_result import CheckResult
from ..training.environment.folder import EXTENSION, FolderState, obstacle, own_folder

MODULE = EXTENSION or __package__.partition(".")[0]
"""Under which Blender keeps the preferences. Imported without being installed, the add-on has none."""

LEVEL_ICONS = {"INFO": "CHECKMARK", "WARNING": "INFO", "ERROR": "ERROR"}
STATE_LABELS = {
    FolderState.MISSING: "Not installed",
    FolderState.HALF_MADE: "Incomplete: its installation was interrupted; reinstall it, or remove it",
    FolderState.BROKEN: "Broken: its Python is missing; reinstall it",
    FolderState.OUTDATED: "Ready, but this add-on expects other versions; reinstall it when convenient",
    FolderState.READY: "Ready",
}


class FDDA_PG_folder(bpy.types.PropertyGroup):
    """A folder that the user trusts: .blend files may name models in it and below."""

    path: StringProperty(
        name="Folder", description="Load models from this folder and its subfolders", subtype="DIR_PATH"
    )


class FDDA_AP_preferences(bpy.types.AddonPreferences):
    """Preferences of the extension."""

    bl_idname = MODULE

    trainer_python: StringProperty(
        name="Existing Python",
        description="Python with PyTorch, or the folder of its virtual environment. Empty for the environment "
        f"variable {choice.PYTHON_VARIABLE}, or else the environment above",
        subtype="FILE_PATH",
        update=lambda _preferences, _context: session.remember(None),
    )
    wheels_folder: StringProperty(
        name="Offline Packages",
        description="Folder of .whl files to install from, for a machine without internet. Empty for the package index",
        subtype="DIR_PATH",
    )

    pack_models: BoolProperty(
        name="Pack Models into the .blend File",
        description="Store models in the .blend file when they are bound, so that they are saved, appended and linked "
        "with it. Models of more than 32 MB are only packed on request",
        default=True,
    )
    folders: CollectionProperty(type=FDDA_PG_folder)

    def draw(self, _context: bpy.types.Context) -> None:
        layout = self.layout
        draw_models(layout, self)
        layout.separator()
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.label(text="Training needs PyTorch, in a Python of its own. Everything else works without it.")
        draw_own_environment(layout, self)
        layout.separator()
        layout.prop(
            self, "trainer_python", text="Existing Python (optional)", placeholder="The training environment above"
        )
        if not self.trainer_python and (named := os.environ.get(choice.PYTHON_VARIABLE)):
            draw_lines(layout, f"{choice.PYTHON_VARIABLE} is set: {named}", "INFO")
        draw_check(layout)


def draw_models(layout: bpy.types.UILayout, own: FDDA_AP_preferences) -> None:
    """Where models are kept, and from which folders they are followed."""
    column = layout.column()
    column.label(text="Models load if packed, or in the .blend file's folder")
    column.prop(own, "pack_models")
    column.label(text="Also load models from:")
    for index, folder in enumerate(own.folders):
        row = column.row(align=True)
        row.prop(folder, "path", text="")
        row.operator("fdda.remove_trusted_folder", text="", icon="REMOVE").index = index
    column.operator("fdda.add_trusted_folder", text="Add Folder…", icon="ADD")


def packs_models() -> bool:
    """Whether models go into the .blend file when they are bound."""
    own = preferences()
    return own is None or own.pack_models


def trusted_folders() -> list[Path]:
    """The folders that the user trusts, absolute and without links."""
    own = preferences()
    return [Path(bpy.path.abspath(folder.path)).resolve() for folder in own.folders if folder.path] if own else []


def preferences() -> FDDA_AP_preferences | None:
    """The preferences, None where the add-on is not installed as an extension."""
    addon = bpy.context.preferences.addons.get(MODULE)
    return addon.preferences if addon else None


def wheels_folder() -> str:
    """The folder of wheels that the user has chosen, empty for none."""
    own = preferences()
    return own.wheels_folder if own else ""


def draw_check(layout: bpy.types.UILayout) -> None:
    """Which Python trains, a button to check it, and what the last check said. Asks nothing."""
    _, right = _split_row(layout)
    right.operator("fdda.check_trainer", text="Check Setup", icon="VIEWZOOM")
    if current(ENVIRONMENT) is None:
        draw_check_result(layout, session.check_result)


def draw_own_environment(layout: bpy.types.UILayout, own: FDDA_AP_preferences) -> None:
    """The environment that the add-on makes: its state, its buttons, its progress."""
    state = session.own_state()
    left, right = _split_row(layout)
    left.label(text="Training Environment")
    right.label(
        text=STATE_LABELS[state], icon="ERROR" if state in (FolderState.HALF_MADE, FolderState.BROKEN) else "NONE"
    )
    layout.prop(own, "wheels_folder", placeholder="None: install from the internet")
    if (job := current(ENVIRONMENT)) is not None:
        draw_job(layout, job)
    else:
        _, row = _split_row(layout)
        row = row.row(align=True)
        reason = obstacle(own.wheels_folder)
        again = state is not FolderState.MISSING
        create = row.row()
        create.enabled = not reason
        text = "Reinstall" if again else "Install Training Environment (3 GB)"
        create.operator("fdda.create_trainer_environment", text=text, icon="IMPORT")
        if again:
            row.operator("fdda.remove_trainer_environment", text="", icon="TRASH")
        row.operator("fdda.open_trainer_log", text="", icon="TEXT")
        if reason:
            draw_lines(layout, f"{reason}.", "INFO")
        draw_check_result(layout, session.notice)
    draw_lines(layout, f"Folder: {own_folder()}")


def _split_row(layout: bpy.types.UILayout) -> tuple[bpy.types.UILayout, bpy.types.UILayout]:
    """A row as Blender splits those of properties: names on the left, values on the right."""
    split = layout.split(factor=0.4)
    left, right = split.row(), split.row()
    left.alignment = "RIGHT"
    return left, right


def draw_job(layout: bpy.types.UILayout, job: JobState) -> None:
    """How far a job is, and a button to cancel it."""
    row = layout.row()
    text = job.stage if len(job.stage) < 90 else f"{job.stage[:88]}…"
    if job.total:
        row.progress(factor=job.fraction, text=f"{text} ({job.done} of {job.total} MB)")
    else:
        row.label(text=f"{job.title}: {text}", icon="SORTTIME")
    if job.can_cancel:
        row.operator("fdda.cancel_trainer_environment", text="", icon="CANCEL")


def draw_check_result(layout: bpy.types.UILayout, answer: CheckResult | None) -> None:
    """What was found out, if anything was."""
    if answer is None:
        return
    box = layout.box()
    draw_lines(box, answer.message, LEVEL_ICONS[answer.level], alert=answer.level == "ERROR")
    column = box.column(align=True)
    column.active = False
    for line in answer.details:
        draw_lines(column, line, "BLANK1")


def draw_lines(layout: bpy.types.UILayout, text: str, icon: str = "NONE", alert: bool = False) -> None:
    """A sentence, wrapped to the width of the region: Blender cuts off what does not fit."""
    import textwrap

    region = bpy.context.region
    scale = bpy.context.preferences.system.ui_scale
    width = int(((region.width if region else 600) / scale - 90) / 6.3)
    column = layout.column(align=True)
    column.alert = alert
    for number, line in enumerate(textwrap.wrap(text, max(width, 30)) or [""]):
        column.label(text=line, icon=icon if number == 0 or icon == "NONE" else "BLANK1")


def _preferred_python() -> str:
    own = preferences()
    return bpy.path.abspath(own.trainer_python) if own else ""


CLASSES = (FDDA_PG_folder, FDDA_AP_preferences)


def register() -> None:
    """Let the trainer's Python be the one that the preferences name."""
    choice.preferred_python = _preferred_python
    folder_trust.trusted_folders = trusted_folders


def unregister() -> None:
    """Undo `register`, and forget what was found out."""
    session.remember(None)
    choice.preferred_python = None
    folder_trust.trusted_folders = list
