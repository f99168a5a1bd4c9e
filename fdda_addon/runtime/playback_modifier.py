# SPDX-License-Identifier: GPL-3.0-or-later
"""The FDDA modifier: a Geometry Nodes modifier that moves the vertices of a mesh to the positions of a position buffer.

The positions are in a mesh of their own, so the user's mesh is never changed, and objects that share a mesh can have
different positions.

Blender runs Geometry Nodes also on a copy of the mesh without deformation, for Generated texture coordinates. This copy
has to keep its positions. It lacks the attribute *rest_position*, which Blender adds to the mesh of an object with *Add
Rest Position* before the first modifier. So the group moves no vertices where this attribute is missing. Blender makes
the copy only where a modifier is on that can do nothing but deform, such as the second modifier that `add_modifiers`
adds, which smooths zero times.
"""

import bpy

from ..rig.modifier_stack import PLAYBACK_GROUP_KEY, UNDEFORMED_MODIFIER_NAME, is_undeformed_modifier
from ..scene.compatibility import node_input, set_node_input
from ..scene.scene_rig import MODIFIER_NAME

GROUP_NAME = "FDDA Playback"
REST_POSITION = "rest_position"
"""The attribute that *Add Rest Position* adds."""


def add_modifiers(mesh_object: bpy.types.Object, index: int) -> None:
    """Add the FDDA modifier, without a position buffer, and the one for undeformed coordinates; reuse existing ones.

    A library override may have the modifier from its library and cannot remove it. An override also loses its binding,
    but not the modifier, when it is saved where the add-on is missing.

    Args:
        index: index of the FDDA modifier in the stack, not counting the modifiers that are added here.
    """
    if find_modifier(mesh_object) is None:
        modifier = mesh_object.modifiers.new(MODIFIER_NAME, "NODES")
        modifier.node_group = _ensure_node_group()
        modifier.show_on_cage = False
    if not any(map(is_undeformed_modifier, mesh_object.modifiers)):
        mesh_object.modifiers.new(UNDEFORMED_MODIFIER_NAME, "SMOOTH").iterations = 0
    modifiers = [modifier for modifier in added_modifiers(mesh_object) if not is_from_library(modifier)]
    for modifier in modifiers:
        modifier.show_viewport = modifier.show_render = modifier.show_expanded = False
        modifier.show_in_editmode = True
        # Behind the others first, so that they do not count in the index.
        mesh_object.modifiers.move(mesh_object.modifiers.find(modifier.name), len(mesh_object.modifiers) - 1)
    for modifier in reversed(modifiers):
        mesh_object.modifiers.move(mesh_object.modifiers.find(modifier.name), index)


def added_modifiers(mesh_object: bpy.types.Object) -> list[bpy.types.Modifier]:
    """Return the modifiers that `add_modifiers` has added, as far as they still exist, the FDDA modifier first."""
    modifiers = [find_modifier(mesh_object), next(filter(is_undeformed_modifier, mesh_object.modifiers), None)]
    return [modifier for modifier in modifiers if modifier is not None]


def remove_modifiers(mesh_object: bpy.types.Object) -> None:
    """Remove what `add_modifiers` has added, except from a library override that has it from its library."""
    for modifier in added_modifiers(mesh_object):
        if not is_from_library(modifier):
            mesh_object.modifiers.remove(modifier)


def find_modifier(mesh_object: bpy.types.Object) -> bpy.types.NodesModifier | None:
    """Find the FDDA modifier of a mesh object; return None when it was removed."""
    return next((modifier for modifier in mesh_object.modifiers if has_playback_group(modifier)), None)


def has_playback_group(modifier: bpy.types.Modifier) -> bool:
    """Return whether a modifier is an FDDA modifier that still has its node group."""
    return modifier.type == "NODES" and modifier.node_group is not None and PLAYBACK_GROUP_KEY in modifier.node_group


def is_from_library(modifier: bpy.types.Modifier) -> bool:
    """Return whether a modifier of a library override comes from its library."""
    return modifier.id_data.override_library is not None and modifier.is_override_data


def buffer_of(modifier: bpy.types.NodesModifier) -> bpy.types.Object | None:
    """Return the position buffer of an FDDA modifier."""
    return node_input(modifier, _input_socket(modifier, "NodeSocketObject"))


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
    set_node_input(modifier, _input_socket(modifier, "NodeSocketObject"), buffer)
    # Setting the input alone does not update the relations of the dependency graph.
    modifier.node_group = modifier.node_group


def add_rest_position(mesh_object: bpy.types.Object, modifier: bpy.types.NodesModifier, keep: bool) -> None:
    """Let Blender add the attribute that the FDDA modifier needs.

    Args:
        mesh_object: the bound object. If its mesh has this attribute of its own, Blender must not overwrite it.
        keep: whether the user has switched *Add Rest Position* on. Else the modifier removes the attribute again.
    """
    has_attribute = REST_POSITION in mesh_object.data.attributes
    adds_attribute = keep or not has_attribute
    if mesh_object.add_rest_position_attribute != adds_attribute:
        mesh_object.add_rest_position_attribute = adds_attribute
    socket, removed_name = _input_socket(modifier, "NodeSocketString"), "" if keep or has_attribute else REST_POSITION
    if node_input(modifier, socket) != removed_name:
        set_node_input(modifier, socket, removed_name)
        mesh_object.update_tag()


def _input_socket(modifier: bpy.types.NodesModifier, socket_type: str) -> str:
    for item in modifier.node_group.interface.items_tree:
        if item.item_type == "SOCKET" and item.in_out == "INPUT" and item.socket_type == socket_type:
            return item.identifier
    raise KeyError(f"the node group '{modifier.node_group.name}' has no input of the type '{socket_type}'")


def _ensure_node_group() -> bpy.types.NodeTree:
    """Return the node group of the file, or create it: Object Info → Sample Index → Set Position.

    It moves no vertices if the mesh lacks the attribute `REST_POSITION`, or if the position buffer is missing or has
    another number of vertices.
    """
    for node_group in bpy.data.node_groups:
        if PLAYBACK_GROUP_KEY in node_group and node_group.library is None:
            return node_group
    node_group = bpy.data.node_groups.new(GROUP_NAME, "GeometryNodeTree")
    node_group[PLAYBACK_GROUP_KEY] = True
    node_group.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    node_group.interface.new_socket("Positions", in_out="INPUT", socket_type="NodeSocketObject")
    node_group.interface.new_socket("Remove Attribute", in_out="INPUT", socket_type="NodeSocketString")
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
    compare_sizes = add_node("FunctionNodeCompare", 3, 2, data_type="INT", operation="EQUAL")
    mesh_size_socket, buffer_size_socket = (socket for socket in compare_sizes.inputs if socket.type == "INT")
    # No attribute has an empty name.
    attribute_name = add_node("GeometryNodeSwitch", 4, 2, input_type="STRING")
    attribute_name.inputs["True"].default_value = REST_POSITION
    rest_position = add_node("GeometryNodeInputNamedAttribute", 5, 1, data_type="FLOAT_VECTOR")
    set_position = add_node("GeometryNodeSetPosition", 6, 0)
    remove_attribute = add_node("GeometryNodeRemoveAttribute", 7, 0)
    group_output = add_node("NodeGroupOutput", 8, 0)
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
        (compare_sizes.outputs["Result"], attribute_name.inputs["Switch"]),
        (attribute_name.outputs["Output"], rest_position.inputs["Name"]),
        (rest_position.outputs["Exists"], set_position.inputs["Selection"]),
        (set_position.outputs["Geometry"], remove_attribute.inputs["Geometry"]),
        (group_input.outputs["Remove Attribute"], remove_attribute.inputs["Name"]),
        (remove_attribute.outputs["Geometry"], group_output.inputs["Geometry"]),
    ):
        node_group.links.new(output_socket, input_socket)
    return node_group
