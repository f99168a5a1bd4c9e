# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads rest positions, topology and evaluated positions of meshes, and writes positions."""

from collections.abc import Collection

import bpy
import numpy as np

from ..core.errors import RigError
from .arrays import (
    COORDINATE_ELEMENT,
    LOOP_START_ELEMENT,
    VECTOR_ELEMENT,
    VERTEX_INDEX_ELEMENT,
    ElementProperty,
    read,
    write,
)
from .temporary_state import animated_paths


def rest_positions(mesh: bpy.types.Mesh) -> np.ndarray:
    """Read the undeformed positions of a mesh, from the reference shape key if the mesh has shape keys.

    Returns:
        (V, 3) float32, mesh-object space, mesh units.
    """
    source = mesh.shape_keys.reference_key.data if mesh.shape_keys else mesh.vertices
    return read(source, COORDINATE_ELEMENT)


def topology(mesh: bpy.types.Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Read the faces of a mesh.

    Returns:
        loop_starts: (F,) int32, index of the first element of each face in `loop_vertices`.
        loop_vertices: (L,) int32, vertex indices, face by face.
    """
    return read(mesh.polygons, LOOP_START_ELEMENT), read(mesh.loops, VERTEX_INDEX_ELEMENT)


def group_weights(mesh_object: bpy.types.Object, names: Collection[str]) -> dict[str, np.ndarray]:
    """Read the weights of the vertex groups with some names, (V,) float32; 0 for vertices that are in no such group.

    In edit mode, the weights are those before the edit.
    """
    groups = {group.index: group.name for group in mesh_object.vertex_groups if group.name in names}
    weights = {name: np.zeros(len(mesh_object.data.vertices), np.float32) for name in groups.values()}
    for vertex in mesh_object.data.vertices if groups else ():
        for element in vertex.groups:
            if element.group in groups:
                weights[groups[element.group]][vertex.index] = element.weight
    return weights


def vertex_layers(mesh_object: bpy.types.Object, names: set[str]) -> dict[str, np.ndarray]:
    """Read the vertex groups and attributes of a mesh object that have one of some names.

    Returns:
        The weights of vertex groups (`group_weights`), and the values of the elements of attributes, one row each.
    """
    layers = group_weights(mesh_object, names)
    for attribute in mesh_object.data.attributes:
        if attribute.name in names and len(attribute.data):
            properties = attribute.data[0].bl_rna.properties
            prop = next(properties[name] for name in ("value", "vector", "color") if name in properties)
            dtype = {"FLOAT": np.float32, "INT": np.int32, "BOOLEAN": np.bool_}.get(prop.type)
            if dtype is not None:
                element = ElementProperty(prop.identifier, dtype, (max(prop.array_length, 1),))
                layers[attribute.name] = read(attribute.data, element)
    return layers


def evaluated_positions(mesh_object: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> np.ndarray:
    """Read the evaluated positions of a mesh object.

    Returns:
        (V, 3) float32, mesh-object space, mesh units.

    Raises:
        RigError: the evaluated mesh has another number of vertices.
    """
    mesh, vertex_count = mesh_object.evaluated_get(depsgraph).data, len(mesh_object.data.vertices)
    if len(mesh.vertices) != vertex_count:
        paths = animated_paths(mesh_object)
        names = [m.name for m in mesh_object.modifiers if any(path.startswith(m.path_from_id()) for path in paths)]
        animated = " (animated: {})".format(", ".join(f"'{name}'" for name in names)) if names else ""
        raise RigError(
            f"In some pose the modifiers of '{mesh_object.name}' turn {vertex_count} vertices into "
            f"{len(mesh.vertices)}; look for a modifier that makes or removes vertices depending on the pose{animated};"
            " switch it off, or remove its animation."
        )
    return mesh_positions(mesh)


def mesh_positions(mesh: bpy.types.Mesh) -> np.ndarray:
    """Read the vertex positions of an original or evaluated mesh.

    Returns:
        (V, 3) float32, object space, mesh units.
    """
    # Reading or writing `vertices` instead of the attribute is about a hundred times slower.
    positions = mesh.attributes.get("position")
    if positions is None:
        # In edit mode a mesh has no attributes; its vertices are those before the edit.
        return read(mesh.vertices, COORDINATE_ELEMENT)
    return read(positions.data, VECTOR_ELEMENT)


def set_mesh_positions(mesh: bpy.types.Mesh, positions: np.ndarray) -> None:
    """Write the vertex positions of a mesh without tagging it.

    Args:
        mesh: an original or evaluated mesh.
        positions: (V, 3) float32, object space, mesh units.
    """
    if not len(positions):
        # A mesh without vertices has no position attribute.
        return
    write(mesh.attributes["position"].data, VECTOR_ELEMENT, positions)
