# SPDX-License-Identifier: GPL-3.0-or-later
"""The position buffer of a bound mesh object: an object whose evaluated mesh holds the vertex positions of the model.

Object and mesh are local runtime data and in no scene. Blender never saves them. A character keeps its buffer while its
rig is shown (`effects`): removing an object in a handler of a render crashes Blender.
"""

import bpy

from ..scene.mesh import mesh_positions, set_mesh_positions
from ..scene.scene_rig import MODIFIER_NAME

BUFFER_KEY = "fdda_position_buffer"
"""Custom property that marks position buffers."""


def create_buffer(mesh_object: bpy.types.Object) -> bpy.types.Object:
    """Create a position buffer with as many vertices as a mesh object, at the rest positions of its mesh."""
    # Blender hides names that begin with a dot where objects are listed, also after an undo.
    name = f".{mesh_object.name} {MODIFIER_NAME} positions"
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(mesh_object.data.vertices))
    set_mesh_positions(mesh, mesh_positions(mesh_object.data))
    buffer = bpy.data.objects.new(name, mesh)
    mesh.is_runtime_data = buffer.is_runtime_data = True
    buffer[BUFFER_KEY] = True
    return buffer


def is_buffer(scene_object: bpy.types.Object) -> bool:
    """Return whether an object is a position buffer of this session."""
    return scene_object.is_runtime_data and BUFFER_KEY in scene_object


def remove_buffer(buffer: bpy.types.Object) -> None:
    """Remove a position buffer and its mesh from the file; a linked buffer stays."""
    if buffer.library is None:
        mesh = buffer.data
        bpy.data.objects.remove(buffer)
        if mesh.users == 0:
            bpy.data.meshes.remove(mesh)
