# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that add and remove trusted folders in the preferences: .blend files may load models from them."""

import bpy

from ..properties.preferences import preferences


class _FolderOperator:
    """Mixin for an operator on the trusted folders."""

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        if preferences() is None:
            cls.poll_message_set("The add-on was started from a script and has no preferences; install the extension")
            return False
        return True


class FDDA_OT_add_trusted_folder(_FolderOperator, bpy.types.Operator):
    bl_idname = "fdda.add_trusted_folder"
    bl_label = "Add Folder"
    bl_description = "Choose a folder from which any .blend file may load models"
    bl_options = {"REGISTER"}

    directory: bpy.props.StringProperty(
        name="Folder", description="The folder", subtype="DIR_PATH", options={"SKIP_SAVE"}
    )

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        if self.directory:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        if not self.directory:
            self.report({"ERROR"}, "No folder was chosen.")
            return {"CANCELLED"}
        preferences().folders.add().path = self.directory
        context.preferences.is_dirty = True
        return {"FINISHED"}


class FDDA_OT_remove_trusted_folder(_FolderOperator, bpy.types.Operator):
    bl_idname = "fdda.remove_trusted_folder"
    bl_label = "Remove Folder"
    bl_description = "Remove the folder from the list. Its files are kept"
    bl_options = {"REGISTER"}

    index: bpy.props.IntProperty(name="Index", description="Index in the list, from 0", min=0, options={"SKIP_SAVE"})

    def execute(self, context: bpy.types.Context) -> set[str]:
        folders = preferences().folders
        if self.index >= len(folders):
            self.report({"ERROR"}, f"No trusted folder has the index {self.index}; the list has {len(folders)}.")
            return {"CANCELLED"}
        folders.remove(self.index)
        context.preferences.is_dirty = True
        return {"FINISHED"}


CLASSES = (FDDA_OT_add_trusted_folder, FDDA_OT_remove_trusted_folder)
