# SPDX-License-Identifier: GPL-3.0-or-later
"""The Geometry Nodes modifier that gives a mesh the positions of a cache object.

The positions lie in a mesh of their own, which is in no scene: the user's mesh is never touched, and objects that
share one mesh datablock can still have different positions.
"""

import bpy
import numpy as np

from ..scene.compatibility import node_input, set_node_input
from ..scene.modifier_stack import PLAYBACK_KEY
from ..scene.scene_rig import MODIFIER_NAME

GROUP_NAME = "FDDA Playback"
GROUP_VERSION = 1


def add_modifier(mesh_object: bpy.types.Object, place: int) -> bpy.types.NodesModifier:
    """Add the modifier at a place of the stack, with a new cache object that holds the mesh's own positions.

    A library override may have one of its library, which cannot be removed; that one serves again. So does one that is
    left from a binding that is gone: an override forgets its binding when it is saved where the add-on is missing.
    """
    modifier = find_modifier(mesh_object)
    if modifier is not None:
        before = cache_of(modifier)
        set_cache(modifier, new_cache(mesh_object))
        remove_cache(before)
        if not is_inherited(modifier):
            now = mesh_object.modifiers.find(modifier.name)
            mesh_object.modifiers.move(now, place - (now < place))
        return modifier
    group = _node_group()
    modifier = mesh_object.modifiers.new(MODIFIER_NAME, "NODES")
    modifier.node_group = group
    modifier.show_render = False
    modifier.show_in_editmode = True
    modifier.show_on_cage = False
    modifier.show_expanded = False
    # Not the last where another modifier is pinned to the end.
    mesh_object.modifiers.move(mesh_object.modifiers.find(modifier.name), place)
    set_node_input(modifier, _cache_socket(group), new_cache(mesh_object))
    return modifier


def find_modifier(mesh_object: bpy.types.Object) -> bpy.types.NodesModifier | None:
    """The modifier that plays a model, None when it was removed."""
    return next((modifier for modifier in mesh_object.modifiers if plays(modifier)), None)


def plays(modifier: bpy.types.Modifier) -> bool:
    """Whether a modifier is one that plays a model."""
    return modifier.type == "NODES" and modifier.node_group is not None and PLAYBACK_KEY in modifier.node_group


def is_inherited(modifier: bpy.types.NodesModifier) -> bool:
    """Whether a library override has a modifier from its library."""
    return modifier.id_data.override_library is not None and modifier.is_override_data


def new_cache(mesh_object: bpy.types.Object) -> bpy.types.Object:
    """A cache object with the vertices of a mesh; it is in no scene."""
    name = f"{mesh_object.name} {MODIFIER_NAME} positions"
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(mesh_object.data.vertices))
    positions = np.empty(len(mesh.vertices) * 3, np.float32)
    mesh_object.data.vertices.foreach_get("co", positions)
    mesh.vertices.foreach_set("co", positions)
    cache = bpy.data.objects.new(name, mesh)
    if mesh_object.library is not None:
        # Saved, it would stay behind in the file: that a linked object uses it is not saved.
        mesh.is_runtime_data = cache.is_runtime_data = True
    return cache


def cache_of(modifier: bpy.types.NodesModifier) -> bpy.types.Object | None:
    """The cache object of a modifier."""
    return node_input(modifier, _cache_socket(modifier.node_group))


def set_cache(modifier: bpy.types.NodesModifier, cache: bpy.types.Object | None) -> None:
    """Give a modifier another cache object, or none."""
    set_node_input(modifier, _cache_socket(modifier.node_group), cache)
    # Setting the input alone does not tell the dependency graph of the new relation.
    modifier.node_group = modifier.node_group


def write_cache(cache: bpy.types.Object, positions: np.ndarray) -> None:
    """Give a cache object positions, (V, 3) float32, and have everything that reads it evaluated again."""
    # Through the attribute: `vertices.foreach_set` is some hundred times slower.
    cache.data.attributes["position"].data.foreach_set("vector", positions.reshape(-1))
    cache.data.update_tag()


def remove_cache(cache: bpy.types.Object | None) -> None:
    """Delete a cache object and its mesh, unless something else uses them."""
    if cache is not None and cache.users == 0 and cache.library is None:
        mesh = cache.data
        bpy.data.objects.remove(cache)
        if mesh.users == 0:
            bpy.data.meshes.remove(mesh)


def _cache_socket(group: bpy.types.NodeTree) -> str:
    for item in group.interface.items_tree:
        if item.item_type == "SOCKET" and item.in_out == "INPUT" and item.socket_type == "NodeSocketObject":
            return item.identifier
    raise KeyError(f"the node group '{group.name}' has no input for the positions")


def _node_group() -> bpy.types.NodeTree:
    """Object Info → Sample Index → Set Position; one group serves all bindings of a file."""
    for group in bpy.data.node_groups:
        if group.get(PLAYBACK_KEY) == GROUP_VERSION and group.library is None:
            return group
    group = bpy.data.node_groups.new(GROUP_NAME, "GeometryNodeTree")
    group[PLAYBACK_KEY] = GROUP_VERSION
    group.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    group.interface.new_socket("Positions", in_out="INPUT", socket_type="NodeSocketObject")
    group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")

    def node(kind: str, column: int, row: int, **settings: str) -> bpy.types.Node:
        new = group.nodes.new(kind)
        new.location = (200 * column, -200 * row)
        for name, value in settings.items():
            setattr(new, name, value)
        return new

    inputs = node("NodeGroupInput", 0, 0)
    info = node("GeometryNodeObjectInfo", 1, 1, transform_space="ORIGINAL")
    position = node("GeometryNodeInputPosition", 1, 2)
    index = node("GeometryNodeInputIndex", 1, 3)
    sample = node("GeometryNodeSampleIndex", 2, 1, data_type="FLOAT_VECTOR", domain="POINT")
    set_position = node("GeometryNodeSetPosition", 3, 0)
    outputs = node("NodeGroupOutput", 4, 0)
    for source, target in (
        (inputs.outputs["Geometry"], set_position.inputs["Geometry"]),
        (inputs.outputs["Positions"], info.inputs["Object"]),
        (info.outputs["Geometry"], sample.inputs["Geometry"]),
        (position.outputs["Position"], sample.inputs["Value"]),
        (index.outputs["Index"], sample.inputs["Index"]),
        (sample.outputs["Value"], set_position.inputs["Position"]),
        (set_position.outputs["Geometry"], outputs.inputs["Geometry"]),
    ):
        group.links.new(source, target)
    return group
