# SPDX-License-Identifier: GPL-3.0-or-later
"""The FDDA modifier: a Geometry Nodes modifier that moves the vertices of a mesh to the positions of a position buffer.

The positions are in a mesh of their own, so the user's mesh is never changed, and objects that share a mesh can have
different positions.
"""

import bpy

from ..rig.modifier_stack import PLAYBACK_GROUP_KEY
from ..scene.compatibility import node_input, set_node_input
from ..scene.scene_rig import MODIFIER_NAME

GROUP_NAME = "FDDA Playback"


def add_modifier(mesh_object: bpy.types.Object, index: int) -> None:
    """Add the FDDA modifier to a mesh object, without a position buffer, or reuse one that it already has.

    A library override may have the modifier from its library and cannot remove it. An override also loses its binding,
    but not the modifier, when it is saved where the add-on is missing.

    Args:
        mesh_object: the object.
        index: index of the modifier in the stack.
    """
    modifier = find_modifier(mesh_object)
    if modifier is not None:
        if not is_from_library(modifier):
            current_index = mesh_object.modifiers.find(modifier.name)
            mesh_object.modifiers.move(current_index, index - (current_index < index))
        return
    modifier = mesh_object.modifiers.new(MODIFIER_NAME, "NODES")
    modifier.node_group = _ensure_node_group()
    modifier.show_viewport = modifier.show_render = False
    modifier.show_in_editmode = True
    modifier.show_on_cage = False
    modifier.show_expanded = False
    # A new modifier is not the last one if another modifier is pinned to the end of the stack.
    mesh_object.modifiers.move(mesh_object.modifiers.find(modifier.name), index)


def find_modifier(mesh_object: bpy.types.Object) -> bpy.types.NodesModifier | None:
    """Find the FDDA modifier of a mesh object; return None when it was removed."""
    return next((modifier for modifier in mesh_object.modifiers if has_playback_group(modifier)), None)


def has_playback_group(modifier: bpy.types.Modifier) -> bool:
    """Return whether a modifier is an FDDA modifier that still has its node group."""
    return modifier.type == "NODES" and modifier.node_group is not None and PLAYBACK_GROUP_KEY in modifier.node_group


def is_from_library(modifier: bpy.types.NodesModifier) -> bool:
    """Return whether a modifier of a library override comes from its library."""
    return modifier.id_data.override_library is not None and modifier.is_override_data


def buffer_of(modifier: bpy.types.NodesModifier) -> bpy.types.Object | None:
    """Return the position buffer of an FDDA modifier."""
    return node_input(modifier, _buffer_socket(modifier.node_group))


def buffer_of_object(mesh_object: bpy.types.Object) -> bpy.types.Object | None:
    """Return the position buffer of the FDDA modifier of a mesh object; None without modifier or buffer."""
    modifier = find_modifier(mesh_object)
    return modifier and buffer_of(modifier)


def disconnect(mesh_object: bpy.types.Object) -> None:
    """Remove the position buffer from the FDDA modifier of a mesh object, if it has one."""
    modifier = find_modifier(mesh_object)
    if modifier is not None and buffer_of(modifier) is not None:
        set_buffer(modifier, None)


def set_buffer(modifier: bpy.types.NodesModifier, buffer: bpy.types.Object | None) -> None:
    """Set the position buffer of an FDDA modifier; None for none."""
    set_node_input(modifier, _buffer_socket(modifier.node_group), buffer)
    # Setting the input alone does not update the relations of the dependency graph.
    modifier.node_group = modifier.node_group


def _buffer_socket(node_group: bpy.types.NodeTree) -> str:
    for item in node_group.interface.items_tree:
        if item.item_type == "SOCKET" and item.in_out == "INPUT" and item.socket_type == "NodeSocketObject":
            return item.identifier
    raise KeyError(f"the node group '{node_group.name}' has no input for the positions")


def _ensure_node_group() -> bpy.types.NodeTree:
    """Return the node group of the file, or create it: Object Info → Sample Index → Set Position.

    It leaves the mesh unchanged if the position buffer is missing or has another number of vertices.
    """
    for node_group in bpy.data.node_groups:
        if PLAYBACK_GROUP_KEY in node_group and node_group.library is None:
            return node_group
    node_group = bpy.data.node_groups.new(GROUP_NAME, "GeometryNodeTree")
    node_group[PLAYBACK_GROUP_KEY] = True
    node_group.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    node_group.interface.new_socket("Positions", in_out="INPUT", socket_type="NodeSocketObject")
    node_group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")

    def add_node(node_type: str, column: int, row: int, **settings: str) -> bpy.types.Node:
        node = node_group.nodes.new(node_type)
        node.location = (200 * column, -200 * row)
        for name, value in settings.items():
            setattr(node, name, value)
        return node

    group_input = add_node("NodeGroupInput", 0, 0)
    object_info = add_node("GeometryNodeObjectInfo", 1, 1, transform_space="ORIGINAL")
    position = add_node("GeometryNodeInputPosition", 1, 2)
    vertex_index = add_node("GeometryNodeInputIndex", 1, 3)
    sample_index = add_node("GeometryNodeSampleIndex", 2, 1, data_type="FLOAT_VECTOR", domain="POINT")
    mesh_size, buffer_size = (add_node("GeometryNodeAttributeDomainSize", 2, row) for row in (2, 3))
    set_position = add_node("GeometryNodeSetPosition", 3, 0)
    compare_sizes = add_node("FunctionNodeCompare", 3, 2, data_type="INT", operation="EQUAL")
    mesh_size_socket, buffer_size_socket = (socket for socket in compare_sizes.inputs if socket.type == "INT")
    switch = add_node("GeometryNodeSwitch", 4, 0, input_type="GEOMETRY")
    group_output = add_node("NodeGroupOutput", 5, 0)
    for output_socket, input_socket in (
        (group_input.outputs["Geometry"], set_position.inputs["Geometry"]),
        (group_input.outputs["Positions"], object_info.inputs["Object"]),
        (object_info.outputs["Geometry"], sample_index.inputs["Geometry"]),
        (position.outputs["Position"], sample_index.inputs["Value"]),
        (vertex_index.outputs["Index"], sample_index.inputs["Index"]),
        (sample_index.outputs["Value"], set_position.inputs["Position"]),
        (group_input.outputs["Geometry"], mesh_size.inputs["Geometry"]),
        (object_info.outputs["Geometry"], buffer_size.inputs["Geometry"]),
        (mesh_size.outputs["Point Count"], mesh_size_socket),
        (buffer_size.outputs["Point Count"], buffer_size_socket),
        (compare_sizes.outputs["Result"], switch.inputs["Switch"]),
        (group_input.outputs["Geometry"], switch.inputs["False"]),
        (set_position.outputs["Geometry"], switch.inputs["True"]),
        (switch.outputs["Output"], group_output.inputs["Geometry"]),
    ):
        node_group.links.new(output_socket, input_socket)
    return node_group
