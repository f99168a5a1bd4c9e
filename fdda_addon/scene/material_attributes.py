# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads which attributes the materials of an object use."""

import bpy

from .node_groups import tree_nodes


def material_attributes(mesh_object: bpy.types.Object) -> set[str]:
    """Return the names of the attributes and UV maps that the materials of an object read."""
    materials = [slot.material for slot in mesh_object.material_slots if slot.material is not None]
    nodes = [node for material in materials for node in tree_nodes(material.node_tree)]
    properties = ("attribute_name", "layer_name", "uv_map")
    return {getattr(node, name) for node in nodes for name in properties if hasattr(node, name)}
