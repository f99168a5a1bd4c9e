# SPDX-License-Identifier: GPL-3.0-or-later
"""Follows the evaluated copies of characters in the dependency graphs of windows and renders."""

import bpy
import numpy as np

from ..scene.arrays import MUTE_ELEMENT, write
from .depsgraph_changes import seen_mode
from .session import session


def tag_new_depsgraph(depsgraph: bpy.types.Depsgraph) -> None:
    """Tag the position buffers of new players, so that a dependency graph evaluates them once more.

    The first evaluation of a graph leaves out the objects that it did not need while the modifier was off.
    """
    # A graph has no id, and Blender reuses the address of a graph for another one.
    depsgraph_key = depsgraph.mode, depsgraph.scene.session_uid, depsgraph.view_layer.name
    new_uids = {uid for uid, player in session.players.items() if depsgraph_key not in player.depsgraph_keys}
    if new_uids:
        for buffer in [o for o in bpy.data.objects if o.session_uid in new_uids]:
            session.players[buffer.session_uid].depsgraph_keys.add(depsgraph_key)
            buffer.data.update_tag()


def mute_shape_keys(mesh_object: bpy.types.Object) -> None:
    """Mute the shape keys of an evaluated object, because Blender mixes them even if no modifier reads the result.

    This is only done in viewports that show the model; everything that shows the rig needs its shape keys, and a bake
    may evaluate the position buffer while renders show the rig. A getter cannot find its graph, so the mark names it.
    The user's settings are restored when Blender copies the shape keys again. Shape keys that another object shares
    stay unmuted.
    """
    if seen_mode(mesh_object) != "VIEWPORT":
        return
    shape_keys = mesh_object.data.shape_keys
    # If the first key is muted, all keys were muted since Blender copied them, or the user muted it.
    if not shape_keys.key_blocks[0].mute and mesh_object.original.data.users == 1:
        write(shape_keys.key_blocks, MUTE_ELEMENT, np.ones(len(shape_keys.key_blocks), bool))
