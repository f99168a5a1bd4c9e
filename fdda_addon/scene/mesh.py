# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes in and out: rest positions, topology, evaluated positions."""

import bpy
import numpy as np

from ..core.errors import RigError


def rest_positions(mesh: bpy.types.Mesh) -> np.ndarray:
    """Positions before anything deforms the mesh: the reference shape key where there are keys.

    Returns:
        (V, 3) float32, mesh-object space, metres.
    """
    source = mesh.shape_keys.reference_key.data if mesh.shape_keys else mesh.vertices
    positions = np.empty((len(mesh.vertices), 3), np.float32)
    source.foreach_get("co", positions.reshape(-1))
    return positions


def topology(mesh: bpy.types.Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Faces of a mesh.

    Returns:
        loop_starts: (F,) int32, where each face starts in `loop_vertices`.
        loop_vertices: (L,) int32, vertex indices, face by face.
    """
    loop_starts = np.empty(len(mesh.polygons), np.int32)
    mesh.polygons.foreach_get("loop_start", loop_starts)
    loop_vertices = np.empty(len(mesh.loops), np.int32)
    mesh.loops.foreach_get("vertex_index", loop_vertices)
    return loop_starts, loop_vertices


def evaluated_positions(mesh_object: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> np.ndarray:
    """What the dependency graph evaluates the mesh to.

    Returns:
        (V, 3) float32, mesh-object space, metres.

    Raises:
        RigError: it has other vertices than the mesh object's own mesh.
    """
    mesh, count = mesh_object.evaluated_get(depsgraph).data, len(mesh_object.data.vertices)
    if len(mesh.vertices) != count:
        raise RigError(
            f"In some pose the modifiers of '{mesh_object.name}' turn {count} vertices into {len(mesh.vertices)}; look "
            "for Geometry Nodes that make or remove vertices depending on the pose, and switch them off."
        )
    positions = np.empty((len(mesh.vertices), 3), np.float32)
    mesh.attributes["position"].data.foreach_get("vector", positions.reshape(-1))
    return positions
