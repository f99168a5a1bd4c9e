# SPDX-License-Identifier: GPL-3.0-or-later
"""The preferences of the add-on: packing of models, trusted folders, and the Python for training."""

import os
import textwrap
from pathlib import Path

import bpy
from bpy.props import BoolProperty, CollectionProperty, StringProperty

from ..jobs.job import current
from ..jobs.state import ENVIRONMENT, JobState
from ..scene import folder_trust
from ..training.environment import choice, session
from ..training.environment.check import CheckResult
from ..training.environment.folder import EXTENSION, FolderState, creation_obstacle, environment_folder, log_path

MODULE = EXTENSION or __package__.partition(".")[0]
"""Name under which Blender stores the preferences of the installed extension. A script has no preferences."""

LEVEL_ICONS = {"INFO": "CHECKMARK", "WARNING": "INFO", "ERROR": "ERROR"}
STATE_LABELS = {
    FolderState.MISSING: "Not installed",
    FolderState.INCOMPLETE: "Incomplete: its installation was interrupted; reinstall it, or remove it",
    FolderState.BROKEN: "Broken: its Python is missing; reinstall it",
    FolderState.OUTDATED: "Ready, but this add-on expects other versions; reinstall it when convenient",
    FolderState.READY: "Ready",
}


class FDDA_PG_folder(bpy.types.PropertyGroup):
    """A folder from which any .blend file may load models."""

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
        update=lambda _preferences, _context: session.store_result(None),
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
        layout.label(text="Training needs PyTorch, in a Python of its own. Everything else works without it.")
        # Draw the state of the training environment, its buttons, and the progress of its job.
        state = session.environment_state()
        name_part, value_part = _split_row(layout)
        name_part.label(text="Training Environment")
        result = session.check_result or session.notice
        chosen_python = self.trainer_python or os.environ.get(choice.PYTHON_VARIABLE)
        if current(ENVIRONMENT) is not None:
            value_part.label(text="…")
        elif result is not None:
            draw_check_result(value_part.column(), result)
        elif chosen_python:
            draw_lines(value_part.column(), f"Not checked: {chosen_python}")
        else:
            icon = "ERROR" if state in (FolderState.INCOMPLETE, FolderState.BROKEN) else "NONE"
            value_part.label(text=STATE_LABELS[state], icon=icon)
        if (job := current(ENVIRONMENT)) is not None:
            draw_job(layout, job)
        else:
            _, row = _split_row(layout)
            row = row.row(align=True)
            reason = creation_obstacle(self.wheels_folder)
            is_installed = state is not FolderState.MISSING
            install_button = row.row()
            install_button.enabled = not reason
            text = "Reinstall" if is_installed else "Install Training Environment (3 GB)"
            install_button.operator("fdda.create_trainer_environment", text=text, icon="IMPORT")
            if is_installed:
                row.operator("fdda.remove_trainer_environment", text="", icon="TRASH")
            if log_path().is_file():
                row.operator("wm.path_open", text="", icon="TEXT").filepath = str(log_path())
            if reason:
                draw_lines(layout, f"{reason}.", "INFO")
        _, right = _split_row(layout)
        right.operator("fdda.check_trainer", text="Check Setup", icon="VIEWZOOM")
        layout.separator()
        # Draw the settings of packing, and the folders from which models are loaded.
        column = layout.column()
        column.label(text="Models load if packed, or in the .blend file's folder")
        column.prop(self, "pack_models")
        column.label(text="Also load models from:")
        for index, folder in enumerate(self.folders):
            row = column.row(align=True)
            row.prop(folder, "path", text="")
            row.operator("fdda.remove_trusted_folder", text="", icon="REMOVE").index = index
        column.operator("fdda.add_trusted_folder", text="Add Folder…", icon="ADD")
        header, body = layout.panel("fdda_preferences_advanced", default_closed=True)
        header.label(text="Offline and Existing Python")
        if body is not None:
            body.use_property_split, body.use_property_decorate = True, False
            body.prop(self, "wheels_folder", placeholder="None: install from the internet")
            body.prop(
                self, "trainer_python", text="Existing Python (optional)", placeholder="The training environment above"
            )
            draw_lines(body, f"Folder: {environment_folder()}")


def packs_models() -> bool:
    """Return whether models are packed when they are bound."""
    settings = preferences()
    return settings is None or settings.pack_models


def trusted_folders() -> list[Path]:
    """Return the trusted folders as absolute paths with symbolic links resolved."""
    settings = preferences()
    folders = settings.folders if settings else ()
    return [Path(bpy.path.abspath(folder.path)).resolve() for folder in folders if folder.path]


def preferences() -> FDDA_AP_preferences | None:
    """Return the preferences; None if the add-on was started from a script."""
    addon = bpy.context.preferences.addons.get(MODULE)
    return addon.preferences if addon else None


def wheels_folder() -> str:
    """Return the folder in the field Offline Packages; empty if none is chosen."""
    settings = preferences()
    return settings.wheels_folder if settings else ""


def _split_row(layout: bpy.types.UILayout) -> tuple[bpy.types.UILayout, bpy.types.UILayout]:
    """Return the parts for name and value of a row, split as Blender splits the rows of properties."""
    split = layout.split(factor=0.4)
    left, right = split.row(), split.row()
    left.alignment = "RIGHT"
    return left, right


def draw_job(layout: bpy.types.UILayout, job: JobState) -> None:
    """Draw the progress of a job, and a button to cancel it."""
    row = layout.row()
    text = job.stage if len(job.stage) < 90 else f"{job.stage[:88]}…"
    if job.total:
        row.progress(factor=job.fraction, text=f"{text} ({job.done} of {job.total} MB)")
    else:
        row.label(text=f"{job.title}: {text}", icon="SORTTIME")
    if job.can_cancel:
        row.operator("fdda.cancel_trainer_environment", text="", icon="CANCEL")


def draw_check_result(layout: bpy.types.UILayout, result: CheckResult | None) -> None:
    """Draw the result of a check, if there is one."""
    if result is None:
        return
    box = layout.box()
    draw_lines(box, result.message, LEVEL_ICONS[result.level], alert=result.level == "ERROR")
    column = box.column(align=True)
    column.active = False
    for line in result.details:
        draw_lines(column, line, "BLANK1")


def draw_lines(layout: bpy.types.UILayout, text: str, icon: str = "NONE", alert: bool = False) -> None:
    """Draw text, wrapped to the width of the region."""
    region = bpy.context.region
    scale = bpy.context.preferences.system.ui_scale
    width = int(((region.width if region else 600) / scale - 90) / 6.3)
    column = layout.column(align=True)
    column.alert = alert
    for index, line in enumerate(textwrap.wrap(text, max(width, 30)) or [""]):
        column.label(text=line, icon=icon if index == 0 or icon == "NONE" else "BLANK1")


def _preferred_python() -> str:
    settings = preferences()
    return bpy.path.abspath(settings.trainer_python) if settings else ""


CLASSES = (FDDA_PG_folder, FDDA_AP_preferences)


def register() -> None:
    """Pass the functions that read the preferences to lower packages, which cannot import this module."""
    choice.preferred_python = _preferred_python
    folder_trust.trusted_folders = trusted_folders


def unregister() -> None:
    """Undo `register`, and clear the result of the last check."""
    session.store_result(None)
    choice.preferred_python = None
    folder_trust.trusted_folders = list
