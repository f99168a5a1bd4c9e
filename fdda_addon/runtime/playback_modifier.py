# SPDX-License-Identifier: GPL-3.0-or-later
"""The Geometry Nodes modifier that gives a mesh the positions of a position buffer.

The positions lie in a mesh of their own, which is in no scene: the user's mesh is never touched, and objects that
share one mesh datablock can still have different positions.
"""

import bpy

from ..rig.modifier_stack import PLAYBACK_KEY
from ..scene.compatibility import node_input, set_node_input
from ..scene.scene_rig import MODIFIER_NAME

GROUP_NAME = "FDDA Playback"


def add_modifier(mesh_object: bpy.types.Object, place: int) -> bpy.types.NodesModifier:
    """Add the modifier at a place of the stack; it is given a position buffer when it plays.

    A library override may have one of its library, which cannot be removed; that one serves again. So does one that is
    left from a binding that is gone: an override forgets its binding when it is saved where the add-on is missing.
    """
    modifier = find_modifier(mesh_object)
    if modifier is not None:
        if not is_inherited(modifier):
            now = mesh_object.modifiers.find(modifier.name)
            mesh_object.modifiers.move(now, place - (now < place))
        return modifier
    modifier = mesh_object.modifiers.new(MODIFIER_NAME, "NODES")
    modifier.node_group = _node_group()
    modifier.show_viewport = modifier.show_render = False
    modifier.show_in_editmode = True
    modifier.show_on_cage = False
    modifier.show_expanded = False
    # Not the last where another modifier is pinned to the end.
    mesh_object.modifiers.move(mesh_object.modifiers.find(modifier.name), place)
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


def buffer_of(modifier: bpy.types.NodesModifier) -> bpy.types.Object | None:
    """The position buffer of a modifier."""
    return node_input(modifier, _buffer_socket(modifier.node_group))


def set_buffer(modifier: bpy.types.NodesModifier, buffer: bpy.types.Object | None) -> None:
    """Give a modifier another position buffer, or none."""
    set_node_input(modifier, _buffer_socket(modifier.node_group), buffer)
    # Setting the input alone does not tell the dependency graph of the new relation.
    modifier.node_group = modifier.node_group


def used_buffers() -> set[bpy.types.Object]:
    """The position buffers that modifiers read."""
    modifiers = (m for o in bpy.data.objects if o.type == "MESH" for m in o.modifiers if plays(m))
    return {buffer for modifier in modifiers if (buffer := buffer_of(modifier)) is not None}


def _buffer_socket(group: bpy.types.NodeTree) -> str:
    for item in group.interface.items_tree:
        if item.item_type == "SOCKET" and item.in_out == "INPUT" and item.socket_type == "NodeSocketObject":
            return item.identifier
    raise KeyError(f"the node group '{group.name}' has no input for the positions")


def _node_group() -> bpy.types.NodeTree:
    """Object Info → Sample Index → Set Position; one group serves all bindings of a file.

    Where the position buffer is missing or has another number of vertices, the mesh stays as it is.
    """
    for group in bpy.data.node_groups:
        if PLAYBACK_KEY in group and group.library is None:
            return group
    group = bpy.data.node_groups.new(GROUP_NAME, "GeometryNodeTree")
    group[PLAYBACK_KEY] = True
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
    mesh_size, buffer_size = (node("GeometryNodeAttributeDomainSize", 2, row) for row in (2, 3))
    set_position = node("GeometryNodeSetPosition", 3, 0)
    equal = node("FunctionNodeCompare", 3, 2, data_type="INT", operation="EQUAL")
    first, second = (socket for socket in equal.inputs if socket.type == "INT")
    switch = node("GeometryNodeSwitch", 4, 0, input_type="GEOMETRY")
    outputs = node("NodeGroupOutput", 5, 0)
    for source, target in (
        (inputs.outputs["Geometry"], set_position.inputs["Geometry"]),
        (inputs.outputs["Positions"], info.inputs["Object"]),
        (info.outputs["Geometry"], sample.inputs["Geometry"]),
        (position.outputs["Position"], sample.inputs["Value"]),
        (index.outputs["Index"], sample.inputs["Index"]),
        (sample.outputs["Value"], set_position.inputs["Position"]),
        (inputs.outputs["Geometry"], mesh_size.inputs["Geometry"]),
        (info.outputs["Geometry"], buffer_size.inputs["Geometry"]),
        (mesh_size.outputs["Point Count"], first),
        (buffer_size.outputs["Point Count"], second),
        (equal.outputs["Result"], switch.inputs["Switch"]),
        (inputs.outputs["Geometry"], switch.inputs["False"]),
        (set_position.outputs["Geometry"], switch.inputs["True"]),
        (switch.outputs["Output"], outputs.inputs["Geometry"]),
    ):
        group.links.new(source, target)
    return group
