# SPDX-License-Identifier: GPL-3.0-or-later
"""Determines the possible effect of Geometry Nodes groups on a mesh from their nodes, without an evaluation."""

from collections.abc import Iterator
from enum import Enum, auto

import bpy

ATTRIBUTE_NODES = {
    "GeometryNodeCaptureAttribute", "GeometryNodeRemoveAttribute", "GeometryNodeReplaceMaterial",
    "GeometryNodeSetGeometryName", "GeometryNodeSetID", "GeometryNodeSetMaterial", "GeometryNodeSetMaterialIndex",
    "GeometryNodeSetMeshNormal", "GeometryNodeSetShadeSmooth", "GeometryNodeStoreNamedAttribute",
    "GeometryNodeViewer", "NodeGroupInput", "NodeReroute",
}  # fmt: skip
"""Nodes that keep the vertices and their positions."""
SHAPE_INDEPENDENT_NODES = (ATTRIBUTE_NODES - {"GeometryNodeSetMeshNormal"}) | {
    "GeometryNodeAccumulateField", "GeometryNodeAttributeDomainSize", "GeometryNodeAttributeStatistic",
    "GeometryNodeBlurAttribute", "GeometryNodeCollectionInfo", "GeometryNodeEvaluateAtIndex",
    "GeometryNodeEvaluateOnDomain", "GeometryNodeFieldAtIndex", "GeometryNodeFieldOnDomain", "GeometryNodeGroup",
    "GeometryNodeIndexSwitch", "GeometryNodeInputActiveCamera", "GeometryNodeInputID", "GeometryNodeInputIndex",
    "GeometryNodeInputMaterial", "GeometryNodeInputMaterialIndex", "GeometryNodeInputMeshEdgeNeighbors",
    "GeometryNodeInputMeshFaceNeighbors", "GeometryNodeInputMeshIsland", "GeometryNodeInputMeshVertexNeighbors",
    "GeometryNodeInputSceneTime", "GeometryNodeInputShadeSmooth", "GeometryNodeIsViewport",
    "GeometryNodeMaterialSelection", "GeometryNodeMenuSwitch", "GeometryNodeObjectInfo", "GeometryNodeSampleIndex",
    "GeometryNodeSelfObject", "GeometryNodeSwitch", "NodeFrame",
}  # fmt: skip
"""Nodes whose results do not depend on the positions of the vertices, beside those of functions and shaders."""
POSITION_NODE = "GeometryNodeSetPosition"
SIMULATION_NODES = {"GeometryNodeSimulationInput", "GeometryNodeSimulationOutput"}
TIME_NODES = {"GeometryNodeInputSceneTime", *SIMULATION_NODES}
BONE_NODE = "GeometryNodeBoneInfo"
"""The node *Bone Info* of Blender 5.2."""
UNLINKED_GEOMETRY = "unlinked"
"""Stands for a geometry input without a link, in place of a node type."""


class GeometryEffect(Enum):
    """The possible effect of the nodes between the input geometry and the output geometry of a group."""

    ATTRIBUTES = auto()
    """They change materials, shading or attributes, and move no vertices."""
    POSITIONS = auto()
    """They move vertices, and keep their number and order."""
    ANY = auto()
    """Only an evaluation shows their effect."""


def geometry_effect(tree: bpy.types.NodeTree | None) -> GeometryEffect:
    """Return the possible effect of a node group on a mesh. A modifier without a group has none."""
    if tree is None:
        return GeometryEffect.ATTRIBUTES
    node_types = set(_geometry_node_types(tree))
    if node_types <= ATTRIBUTE_NODES:
        return GeometryEffect.ATTRIBUTES
    return GeometryEffect.POSITIONS if node_types <= ATTRIBUTE_NODES | {POSITION_NODE} else GeometryEffect.ANY


def find_time_node(tree: bpy.types.NodeTree | None) -> bpy.types.Node | None:
    """Find a node whose result depends on time, in the group or in nested groups; return None if there is none."""
    for node in tree.nodes if tree is not None else ():
        if node.mute:
            continue
        if node.bl_idname in TIME_NODES:
            return node
        if node.type == "GROUP" and (nested_node := find_time_node(node.node_tree)):
            return nested_node
    return None


def read_bone_names(tree: bpy.types.NodeTree | None) -> Iterator[str]:
    """Yield the names of the bones that the nodes *Bone Info* of a group and of nested groups read.

    An empty name stands for a bone that a linked socket names, which may be any bone.
    """
    for socket in (node.inputs["Bone Name"] for node in tree_nodes(tree) if node.bl_idname == BONE_NODE):
        yield "" if socket.is_linked else socket.default_value


def read_texts(tree: bpy.types.NodeTree | None) -> Iterator[str]:
    """Yield the texts in the nodes of a group and of nested groups, among them the names of attributes."""
    for node in tree_nodes(tree):
        yield from (socket.default_value for socket in node.inputs if socket.type == "STRING" and not socket.is_linked)
        if node.bl_idname == "FunctionNodeInputString":
            yield node.string


def _geometry_node_types(tree: bpy.types.NodeTree) -> Iterator[str]:
    """Yield the types of the nodes through which the output geometry passes, including nodes of nested groups."""
    nodes_to_visit = [n for n in tree.nodes if n.bl_idname == "NodeGroupOutput" and n.is_active_output]
    if not nodes_to_visit:
        yield UNLINKED_GEOMETRY
    visited_names = {node.name for node in nodes_to_visit}
    while nodes_to_visit:
        node = nodes_to_visit.pop()
        if node.bl_idname != "NodeGroupOutput" and not node.mute:
            if node.type == "GROUP" and node.node_tree is not None:
                yield from _geometry_node_types(node.node_tree)
            elif node.bl_idname == "GeometryNodeStoreNamedAttribute" and _may_name_positions(node):
                yield POSITION_NODE
            else:
                yield node.bl_idname
        for socket in node.inputs:
            if socket.type != "GEOMETRY" or not socket.enabled:
                continue
            links = [link for link in socket.links if not link.is_muted]
            if not links:
                yield UNLINKED_GEOMETRY
            source_nodes = {link.from_node.name: link.from_node for link in links}
            nodes_to_visit += [source for name, source in source_nodes.items() if name not in visited_names]
            visited_names.update(source_nodes)


def _may_name_positions(node: bpy.types.Node) -> bool:
    name = node.inputs["Name"]
    return name.is_linked or name.default_value == "position"


def depends_on_shape(tree: bpy.types.NodeTree) -> bool:
    """Return whether the result of a node group may depend on the positions of the vertices."""
    return any(_depends_on_shape(node) for node in tree_nodes(tree))


def stored_attributes(tree: bpy.types.NodeTree) -> set[str] | None:
    """Return the names of the attributes that a node group stores; None if it may change anything else of the mesh."""
    outputs = [item for item in tree.interface.items_tree if item.item_type == "SOCKET" and item.in_out == "OUTPUT"]
    if len(outputs) > 1 or not set(_geometry_node_types(tree)) <= {
        "GeometryNodeStoreNamedAttribute",
        "NodeGroupInput",
        "NodeReroute",
    }:
        return None
    sockets = [n.inputs["Name"] for n in tree_nodes(tree) if n.bl_idname == "GeometryNodeStoreNamedAttribute"]
    return None if any(socket.is_linked for socket in sockets) else {socket.default_value for socket in sockets}


def tree_nodes(tree: bpy.types.NodeTree | None) -> Iterator[bpy.types.Node]:
    """Yield the nodes of a group and of nested groups."""
    for node in tree.nodes if tree is not None else ():
        yield node
        if node.type == "GROUP":
            yield from tree_nodes(node.node_tree)


def _depends_on_shape(node: bpy.types.Node) -> bool:
    if node.bl_idname == "GeometryNodeInputNamedAttribute":
        return _may_name_positions(node)
    if node.bl_idname.startswith("ShaderNodeTex"):
        # Without a link, the vector is the position.
        return not all(socket.is_linked for socket in node.inputs if socket.name == "Vector" and socket.enabled)
    return not (
        node.mute
        or node.bl_idname in SHAPE_INDEPENDENT_NODES
        or node.bl_idname.startswith(("FunctionNode", "NodeGroup", "ShaderNode"))
    )
