# SPDX-License-Identifier: GPL-3.0-or-later
"""What stands in a .blend file is the true rig: models give it back before a save and play on afterwards.

So a file that is opened where the add-on is missing, by a colleague or on a render farm, shows and renders the rig. The
mode is saved with it; where the add-on is there, the models play when the file has been loaded.
"""

import bpy

from . import switch


def give_back_rigs() -> None:
    """Let the rigs of the open file show as if no model played."""
    for mesh_object in bpy.data.objects:
        # Linked ones too, which are not saved: of a library override Blender saves how it differs from them.
        if mesh_object.type == "MESH" and mesh_object.fdda.is_playing:
            switch.give_back(mesh_object)


def resume() -> None:
    """Let the models play that `give_back_rigs`, or the saved file, has switched off."""
    for mesh_object in bpy.data.objects:
        if mesh_object.type == "MESH" and mesh_object.fdda.is_bound:
            binding = mesh_object.fdda
            if binding.mode != "RIG" and not binding.is_playing:
                switch.switch_modifiers(mesh_object)
