# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes in and out: rest positions, topology, evaluated positions."""

import bpy
import numpy as np

from ..core.errors import RigError
from .arrays import COORDINATE, LOOP_START, VECTOR, VERTEX_INDEX, read, write


def rest_positions(mesh: bpy.types.Mesh) -> np.ndarray:
    """Positions before anything deforms the mesh: the reference shape key where there are keys.

    Returns:
        (V, 3) float32, mesh-object space, mesh units.
    """
    source = mesh.shape_keys.reference_key.data if mesh.shape_keys else mesh.vertices
    return read(source, COORDINATE)


def topology(mesh: bpy.types.Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Faces of a mesh.

    Returns:
        loop_starts: (F,) int32, where each face starts in `loop_vertices`.
        loop_vertices: (L,) int32, vertex indices, face by face.
    """
    return read(mesh.polygons, LOOP_START), read(mesh.loops, VERTEX_INDEX)


def evaluated_positions(mesh_object: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> np.ndarray:
    """What the dependency graph evaluates the mesh to.

    Returns:
        (V, 3) float32, mesh-object space, mesh units.

    Raises:
        RigError: it has other vertices than the mesh object's own mesh.
    """
    mesh, count = mesh_object.evaluated_get(depsgraph).data, len(mesh_object.data.vertices)
    if len(mesh.vertices) != count:
        raise RigError(
            f"In some pose the modifiers of '{mesh_object.name}' turn {count} vertices into {len(mesh.vertices)}; look "
            "for Geometry Nodes that make or remove vertices depending on the pose, and switch them off."
        )
    return mesh_positions(mesh)


def mesh_positions(mesh: bpy.types.Mesh) -> np.ndarray:
    """Positions of the vertices of a mesh, original or evaluated: (V, 3) float32, its object's space, metres."""
    # Through the attribute: reading or writing the vertices themselves is some hundred times slower.
    positions = mesh.attributes.get("position")
    if positions is None:
        # In edit mode a mesh has no attributes; its vertices are where they were before.
        return read(mesh.vertices, COORDINATE)
    return read(positions.data, VECTOR)


def set_mesh_positions(mesh: bpy.types.Mesh, positions: np.ndarray) -> None:
    """Move the vertices of a mesh: (V, 3) float32, its object's space, metres. Nothing is tagged."""
    if not len(positions):
        # A mesh without vertices has no positions.
        return
    write(mesh.attributes["position"].data, VECTOR, positions)
