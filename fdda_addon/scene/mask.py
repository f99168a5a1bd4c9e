# SPDX-License-Identifier: GPL-3.0-or-later
"""The vertex group that says where a model counts, as its mesh object keeps it (`Object.fdda`)."""

import bpy
import numpy as np

from ..core.mask import Mask


def mask_key(mesh_object: bpy.types.Object) -> tuple[int, bool]:
    """What a mask is read by: the index of its vertex group, -1 where there is none, and whether it is inverted.

    A group that is gone counts as none, as it does for Blender's own modifiers.
    """
    binding = mesh_object.fdda
    return (mesh_object.vertex_groups.find(binding.mask) if binding.mask else -1), binding.invert_mask


def read_mask(mesh_object: bpy.types.Object) -> Mask | None:
    """The mask of a mesh object; None where the model counts everywhere.

    Args:
        mesh_object: original, not evaluated. In edit mode the weights are those from before.
    """
    group, is_inverted = mask_key(mesh_object)
    if group < 0:
        return None
    weights = np.zeros(len(mesh_object.data.vertices), np.float32)
    for vertex in mesh_object.data.vertices:
        for element in vertex.groups:
            if element.group == group:
                weights[vertex.index] = element.weight
                break
    return Mask.of(1 - weights if is_inverted else weights)
