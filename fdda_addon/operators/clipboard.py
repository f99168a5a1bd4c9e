# SPDX-License-Identifier: GPL-3.0-or-later
"""Copy Objects of Blender, for characters that play: what lands on the clipboard is the true rig.

Blender calls nobody before it writes the clipboard. So the key that copies objects in the 3D View comes here first, and
is passed on where no model plays. The entry of the menu Object cannot be had that way.
"""

import bpy

_keys: list[tuple[bpy.types.KeyMap, bpy.types.KeyMapItem]] = []


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
        from ..runtime import playback

        with playback.suspended_playback():
            result = bpy.ops.view3d.copybuffer()
        return result

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        if not any(o.type == "MESH" and o.fdda.is_playing for o in bpy.data.objects):
            return {"PASS_THROUGH"}
        return self.execute(context)


CLASSES = (FDDA_OT_copy_objects,)


def register() -> None:
    """Take the key of Blender's own operator; a Blender without a window has no keys."""
    configuration = bpy.context.window_manager.keyconfigs.addon
    if configuration is not None:
        keymap = configuration.keymaps.new("3D View", space_type="VIEW_3D")
        key = {"oskey" if bpy.app.build_platform == b"Darwin" else "ctrl": True}
        _keys.append((keymap, keymap.keymap_items.new(FDDA_OT_copy_objects.bl_idname, "C", "PRESS", **key)))


def unregister() -> None:
    """Undo `register`."""
    for keymap, item in _keys:
        keymap.keymap_items.remove(item)
    _keys.clear()
