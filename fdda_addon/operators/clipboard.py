# SPDX-License-Identifier: GPL-3.0-or-later
"""Copies objects to the clipboard with the rigs' modifiers restored, in place of Blender's Copy Objects.

Blender has no handler that runs before the clipboard is written. So this operator has the same shortcut in the 3D View,
and passes the event on if no model plays. It cannot replace the entry in the Object menu.
"""

import bpy

from ..runtime import playback


class FDDA_OT_copy_objects(bpy.types.Operator):
    bl_idname = "fdda.copy_objects"
    bl_label = "Copy Objects with Their Rigs"
    bl_description = "Copy the selected objects to the clipboard, and restore the rigs of characters that play a model"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if context.mode != "OBJECT":
            cls.poll_message_set("Objects can only be copied in Object Mode")
            return False
        return bpy.ops.view3d.copybuffer.poll()

    def execute(self, _context: bpy.types.Context) -> set[str]:
        with playback.suspended_playback():
            result = bpy.ops.view3d.copybuffer()
        return result

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        if not any(o.type == "MESH" and o.fdda.is_playing for o in bpy.data.objects):
            return {"PASS_THROUGH"}
        return self.execute(context)


CLASSES = (FDDA_OT_copy_objects,)


def register() -> None:
    """Add the shortcut. In the background Blender has no key configuration."""
    key_configuration = bpy.context.window_manager.keyconfigs.addon
    if key_configuration is not None:
        keymap = key_configuration.keymaps.new("3D View", space_type="VIEW_3D")
        modifier_key = {"oskey" if bpy.app.build_platform == b"Darwin" else "ctrl": True}
        keymap.keymap_items.new(FDDA_OT_copy_objects.bl_idname, "C", "PRESS", **modifier_key)


def unregister() -> None:
    """Undo `register`."""
    key_configuration = bpy.context.window_manager.keyconfigs.addon
    # Other add-ons may have made a key map of the same name for another editor.
    for keymap in key_configuration.keymaps if key_configuration is not None else ():
        for item in [i for i in keymap.keymap_items if i.idname == FDDA_OT_copy_objects.bl_idname]:
            keymap.keymap_items.remove(item)
