# SPDX-License-Identifier: GPL-3.0-or-later
"""What a group of Geometry Nodes does to a mesh, as far as its nodes say. Nothing is evaluated."""

from collections.abc import Iterator
from enum import Enum, auto

import bpy

ATTRIBUTE_NODES = {
    "GeometryNodeCaptureAttribute", "GeometryNodeRemoveAttribute", "GeometryNodeReplaceMaterial",
    "GeometryNodeSetGeometryName", "GeometryNodeSetID", "GeometryNodeSetMaterial", "GeometryNodeSetMaterialIndex",
    "GeometryNodeSetMeshNormal", "GeometryNodeSetShadeSmooth", "GeometryNodeStoreNamedAttribute",
    "GeometryNodeViewer", "NodeGroupInput", "NodeReroute",
}  # fmt: skip
POSITION_NODE = "GeometryNodeSetPosition"
SIMULATION_NODES = {"GeometryNodeSimulationInput", "GeometryNodeSimulationOutput"}
TIME_NODES = {"GeometryNodeInputSceneTime", *SIMULATION_NODES}
UNLINKED = "unlinked"


class GeometryEffect(Enum):
    """What the nodes between the geometry that comes in and the one that goes out can do to a mesh."""

    ATTRIBUTES = auto()
    """Materials, shading, attributes: vertices stay where they are."""
    POSITIONS = auto()
    """Vertices move; there are as many as before, in the same order."""
    ANY = auto()
    """More than the nodes alone tell."""


def geometry_effect(tree: bpy.types.NodeTree | None) -> GeometryEffect:
    """What a node group can do to a mesh. A modifier without a group does nothing."""
    if tree is None:
        return GeometryEffect.ATTRIBUTES
    kinds = set(_on_the_way(tree))
    if kinds <= ATTRIBUTE_NODES:
        return GeometryEffect.ATTRIBUTES
    return GeometryEffect.POSITIONS if kinds <= ATTRIBUTE_NODES | {POSITION_NODE} else GeometryEffect.ANY


def find_time_node(tree: bpy.types.NodeTree | None) -> bpy.types.Node | None:
    """A node, in the group or in groups that it uses, whose result depends on time; None when there is none."""
    for node in tree.nodes if tree is not None else ():
        if node.mute:
            continue
        if node.bl_idname in TIME_NODES:
            return node
        if node.type == "GROUP" and (found := find_time_node(node.node_tree)):
            return found
    return None


def _on_the_way(tree: bpy.types.NodeTree) -> Iterator[str]:
    """Kinds of the nodes that geometry passes on its way out, those of nested groups included."""
    open_nodes = [n for n in tree.nodes if n.bl_idname == "NodeGroupOutput" and n.is_active_output]
    if not open_nodes:
        yield UNLINKED
    seen = {node.name for node in open_nodes}
    while open_nodes:
        node = open_nodes.pop()
        if node.bl_idname != "NodeGroupOutput" and not node.mute:
            yield from _kinds(node)
        for socket in node.inputs:
            if socket.type != "GEOMETRY" or not socket.enabled:
                continue
            links = [link for link in socket.links if not link.is_muted]
            if not links:
                yield UNLINKED
            sources = {link.from_node.name: link.from_node for link in links}
            open_nodes += [source for name, source in sources.items() if name not in seen]
            seen.update(sources)


def _kinds(node: bpy.types.Node) -> Iterator[str]:
    if node.type == "GROUP" and node.node_tree is not None:
        yield from _on_the_way(node.node_tree)
    elif node.bl_idname == "GeometryNodeStoreNamedAttribute" and _may_store_positions(node):
        yield POSITION_NODE
    else:
        yield node.bl_idname


def _may_store_positions(node: bpy.types.Node) -> bool:
    name = node.inputs["Name"]
    return name.is_linked or name.default_value == "position"
