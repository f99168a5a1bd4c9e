# SPDX-License-Identifier: GPL-3.0-or-later
"""The add-on's preferences: which Python trains, and the environment that the add-on can make for it."""

import os

import bpy
from bpy.props import StringProperty

from .trainer_environment import choice, session
from .trainer_environment.folder import EXTENSION, FolderState, obstacle, own_folder

MODULE = EXTENSION or __package__
"""Under which Blender keeps the preferences. Imported without being installed, the add-on has none."""

ICONS = {"INFO": "CHECKMARK", "WARNING": "INFO", "ERROR": "ERROR"}
SHORT = {
    FolderState.MISSING: "Not created",
    FolderState.HALF_MADE: "Half-made: its creation was interrupted; create it again, or remove it",
    FolderState.BROKEN: "Broken: its Python is gone; create it again",
    FolderState.OUTDATED: "Ready, with other versions than this add-on asks for; create it again when it suits",
    FolderState.READY: "Ready",
}


class FDDA_AP_preferences(bpy.types.AddonPreferences):
    """Preferences of the extension."""

    bl_idname = MODULE

    trainer_python: StringProperty(
        name="Python",
        description="A Python that has torch, or the folder of a virtual environment with it. Empty: the environment "
        f"variable {choice.PYTHON_VARIABLE}, else the environment below",
        subtype="FILE_PATH",
        update=lambda _preferences, _context: session.remember(None),
    )
    wheels_folder: StringProperty(
        name="Wheels",
        description="Install the environment from the wheels in this folder, on a machine that is not online. Empty: "
        "from the package index",
        subtype="DIR_PATH",
    )

    def draw(self, _context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.label(text="Training needs PyTorch, in a Python of its own. Everything else works without it.")
        layout.prop(self, "trainer_python", placeholder="The trainer environment below")
        if not self.trainer_python and (named := os.environ.get(choice.PYTHON_VARIABLE)):
            draw_lines(layout, f"{choice.PYTHON_VARIABLE} is set: {named}", "INFO")
        draw_check(layout)
        layout.separator()
        draw_own_environment(layout, self)


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
    _, right = _split(layout)
    right.operator("fdda.check_trainer", text="Check", icon="QUESTION")
    if session.task is None:
        draw_answer(layout, session.answer)


def draw_own_environment(layout: bpy.types.UILayout, own: FDDA_AP_preferences) -> None:
    """The environment that the add-on makes: its state, its buttons, its progress."""
    state = session.own_state()
    left, right = _split(layout)
    left.label(text="Trainer Environment")
    right.label(text=SHORT[state], icon="ERROR" if state in (FolderState.HALF_MADE, FolderState.BROKEN) else "NONE")
    layout.prop(own, "wheels_folder", placeholder="None: install from the network")
    if session.task is not None:
        draw_task(layout, session.task)
    else:
        _, row = _split(layout)
        row = row.row(align=True)
        reason = obstacle(own.wheels_folder)
        again = state is not FolderState.MISSING
        create = row.row()
        create.enabled = not reason
        text = "Create Again" if again else "Create Trainer Environment"
        create.operator("fdda.create_trainer_environment", text=text, icon="IMPORT")
        if again:
            row.operator("fdda.remove_trainer_environment", text="", icon="TRASH")
        row.operator("fdda.open_trainer_log", text="", icon="TEXT")
        if reason:
            draw_lines(layout, f"{reason}.", "INFO")
        draw_answer(layout, session.notice)
    draw_lines(layout, f"Folder: {own_folder()}")


def _split(layout: bpy.types.UILayout) -> tuple[bpy.types.UILayout, bpy.types.UILayout]:
    """A row as Blender splits those of properties: names on the left, values on the right."""
    split = layout.split(factor=0.4)
    left, right = split.row(), split.row()
    left.alignment = "RIGHT"
    return left, right


def draw_task(layout: bpy.types.UILayout, task: session.Task) -> None:
    """How far a task is, and a button to cancel it."""
    progress = task.progress
    row = layout.row()
    text = progress.stage if len(progress.stage) < 90 else f"{progress.stage[:88]}…"
    if progress.total:
        row.progress(factor=progress.done / progress.total, text=f"{text} ({progress.done} of {progress.total} MB)")
    else:
        row.label(text=f"{task.title}: {text}", icon="SORTTIME")
    if task.can_cancel:
        row.operator("fdda.cancel_trainer_environment", text="", icon="CANCEL")


def draw_answer(layout: bpy.types.UILayout, answer: session.Answer | None) -> None:
    """What was found out, if anything was."""
    if answer is None:
        return
    box = layout.box()
    draw_lines(box, answer.message, ICONS[answer.level], alert=answer.level == "ERROR")
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


def register() -> None:
    bpy.utils.register_class(FDDA_AP_preferences)
    choice.preferred_python = _preferred_python


def unregister() -> None:
    session.stop()
    choice.preferred_python = None
    bpy.utils.unregister_class(FDDA_AP_preferences)
