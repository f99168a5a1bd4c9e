# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes in and out: rest positions, topology, skin weights, evaluated positions."""

import bpy
import numpy as np

from ..core.errors import RigError

MIN_INFLUENCES = 4
"""Skin weights have at least this many places a vertex (docs/recording.md)."""


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


def skin_weights(mesh_object: bpy.types.Object, joints: dict[str, int]) -> tuple[np.ndarray, np.ndarray]:
    """Normalised weights of the vertex groups that belong to joints.

    Args:
        mesh_object: the mesh object.
        joints: joint index by bone name.

    Returns:
        skin_joints (V, I) int32 and skin_weights (V, I) float32, rows of weights sum to 1; I is 4 or more.

    Raises:
        RigError: a vertex follows no joint.
    """
    joint_of_group = {group.index: joints[group.name] for group in mesh_object.vertex_groups if group.name in joints}
    rows = [
        [(joint_of_group[g.group], g.weight) for g in vertex.groups if g.weight > 0 and g.group in joint_of_group]
        for vertex in mesh_object.data.vertices
    ]
    if unweighted := [index for index, row in enumerate(rows) if not row]:
        shown = ", ".join(map(str, unweighted[:5])) + (", …" if len(unweighted) > 5 else "")
        raise RigError(
            f"{len(unweighted)} of the {len(rows)} vertices of '{mesh_object.name}' have no weight on a deforming bone "
            f"(vertex {shown}); give each a weight in the vertex group of a bone."
        )
    influences = max(MIN_INFLUENCES, max(map(len, rows)))
    indices = np.zeros((len(rows), influences), np.int32)
    weights = np.zeros((len(rows), influences), np.float32)
    for vertex, row in enumerate(rows):
        indices[vertex, : len(row)] = [joint for joint, _ in row]
        weights[vertex, : len(row)] = [weight for _, weight in row]
    return indices, weights / weights.sum(axis=1, keepdims=True)


def used_groups(mesh_object: bpy.types.Object) -> set[str]:
    """Names of the vertex groups that hold a vertex."""
    used = {g.group for vertex in mesh_object.data.vertices for g in vertex.groups if g.weight > 0}
    return {group.name for group in mesh_object.vertex_groups if group.index in used}


def evaluated_positions(mesh_object: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> np.ndarray:
    """What the dependency graph evaluates the mesh to.

    Returns:
        (V', 3) float32, mesh-object space, metres; V' differs from V when a modifier changes the topology.
    """
    mesh = mesh_object.evaluated_get(depsgraph).data
    positions = np.empty((len(mesh.vertices), 3), np.float32)
    mesh.attributes["position"].data.foreach_get("vector", positions.reshape(-1))
    return positions
