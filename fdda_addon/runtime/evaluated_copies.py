# SPDX-License-Identifier: GPL-3.0-or-later
"""Changes the evaluated copies of characters in dependency graphs."""

import bpy
import numpy as np

from ..scene.arrays import MUTE_ELEMENT, ElementProperty, write
from .depsgraph_changes import seen_mode

SHOW_VIEWPORT_ELEMENT = ElementProperty("show_viewport", np.bool_)


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


def show_rig_to_exporters(mesh_object: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> None:
    """Mark the modifiers of the rig as on in the viewport, in the evaluated copy of an object of a render graph.

    The USD exporter evaluates such a graph, but looks there for an Armature modifier that is on in the viewport: only
    then it writes skeleton, weights and rest pose. For the graph itself this setting means nothing.
    """
    evaluated = mesh_object.evaluated_get(depsgraph)
    if evaluated.is_evaluated:
        visibility = {stored.uid: stored.show_viewport for stored in mesh_object.fdda.modifiers}
        shown = [visibility.get(m.persistent_uid, m.show_viewport) for m in evaluated.modifiers]
        write(evaluated.modifiers, SHOW_VIEWPORT_ELEMENT, np.array(shown, bool))
