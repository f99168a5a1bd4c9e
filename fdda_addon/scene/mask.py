# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads the mask of a bound object: the vertex group that limits the model to a part of the mesh (`Object.fdda`)."""

import bpy

from ..core.mathematics.mask import Mask
from .mesh import group_weights


def mask_key(mesh_object: bpy.types.Object) -> tuple[int, bool]:
    """Return the index of the mask's vertex group, -1 for none, and whether the mask is inverted.

    A group that was removed counts as none, as for Blender's own modifiers.
    """
    binding = mesh_object.fdda
    return (mesh_object.vertex_groups.find(binding.mask) if binding.mask else -1), binding.invert_mask


def read_mask(mesh_object: bpy.types.Object) -> Mask | None:
    """Read the mask of a mesh object; return None if the model applies to the whole mesh.

    Args:
        mesh_object: the original object, not an evaluated one. In edit mode, the weights are those before
            the edit.
    """
    binding = mesh_object.fdda
    weights = group_weights(mesh_object, {binding.mask} - {""}).get(binding.mask)
    return None if weights is None else Mask.from_weights(1 - weights if binding.invert_mask else weights)
