# SPDX-License-Identifier: GPL-3.0-or-later
"""Tells what one modifier does to a mesh: whether it moves vertices, changes the topology or depends on time."""

from enum import Enum, auto

import bpy

from ..scene.compatibility import node_input_settings
from ..scene.node_groups import (
    GeometryEffect,
    depends_on_shape,
    find_time_node,
    geometry_effect,
    named_attributes,
    stored_attributes,
)

DEFORMING_TYPES = {
    "ARMATURE", "CAST", "CLOTH", "CORRECTIVE_SMOOTH", "CURVE", "DISPLACE", "HOOK", "LAPLACIANDEFORM",
    "LAPLACIANSMOOTH", "LATTICE", "MESH_CACHE", "MESH_DEFORM", "MESH_SEQUENCE_CACHE", "SHRINKWRAP", "SIMPLE_DEFORM",
    "SMOOTH", "SOFT_BODY", "SURFACE_DEFORM", "WARP", "WAVE",
}  # fmt: skip
TOPOLOGY_CHANGING_TYPES = {
    "ARRAY", "BEVEL", "BOOLEAN", "BUILD", "DECIMATE", "EDGE_SPLIT", "EXPLODE", "MASK", "MIRROR", "MULTIRES",
    "PARTICLE_INSTANCE", "REMESH", "SCREW", "SKIN", "SOLIDIFY", "SUBSURF", "VOLUME_TO_MESH", "WELD", "WIREFRAME",
}  # fmt: skip
TIME_DEPENDENT_TYPES = {
    "BUILD": "changes with time", "CLOTH": "is a simulation", "DYNAMIC_PAINT": "is a simulation",
    "EXPLODE": "is a simulation", "FLUID": "is a simulation", "MESH_CACHE": "plays a cache",
    "MESH_SEQUENCE_CACHE": "plays a cache", "OCEAN": "changes with time", "PARTICLE_INSTANCE": "is a simulation",
    "SOFT_BODY": "is a simulation", "WAVE": "changes with time",
}  # fmt: skip
BIND_PROPERTIES = {
    "CORRECTIVE_SMOOTH": "is_bind", "LAPLACIANDEFORM": "is_bind", "MESH_DEFORM": "is_bound",
    "SURFACE_DEFORM": "is_bound",
}  # fmt: skip
"""Types of modifiers that must be bound to a rest pose, and their property that is true if they are bound."""
INDIRECT_TYPES = {
    "DATA_TRANSFER", "TRIANGULATE", "VERTEX_WEIGHT_EDIT", "VERTEX_WEIGHT_MIX", "VERTEX_WEIGHT_PROXIMITY",
}  # fmt: skip
"""Modifiers that move no vertices, but change the effect of later modifiers: they edit weights or edges."""


class ModifierEffect(Enum):
    NEUTRAL = auto()
    """Keeps the vertices and their positions: it changes UV maps, weights or normals, or emits particles."""
    DEFORMS = auto()
    """Moves vertices."""
    GENERATES = auto()
    """Changes the topology."""
    UNKNOWN = auto()
    """Only an evaluation shows whether it deforms or generates."""


def effect_of(modifier: bpy.types.Modifier) -> ModifierEffect:
    """Return what a modifier does to the mesh, on or off, judged without an evaluation."""
    if modifier.type == "NODES":
        kinds = {
            GeometryEffect.ATTRIBUTES: ModifierEffect.NEUTRAL,
            GeometryEffect.POSITIONS: ModifierEffect.DEFORMS,
            GeometryEffect.ANY: ModifierEffect.UNKNOWN,
        }
        return kinds[geometry_effect(modifier.node_group)]
    if modifier.type == "OCEAN":
        return ModifierEffect.DEFORMS if modifier.geometry_mode == "DISPLACE" else ModifierEffect.GENERATES
    if modifier.type == "FLUID":
        return ModifierEffect.GENERATES if modifier.fluid_type == "DOMAIN" else ModifierEffect.NEUTRAL
    if modifier.type == "DYNAMIC_PAINT":
        surfaces = modifier.canvas_settings.canvas_surfaces if modifier.canvas_settings else ()
        return (
            ModifierEffect.DEFORMS
            if any(s.surface_type in {"DISPLACE", "WAVE"} for s in surfaces)
            else ModifierEffect.NEUTRAL
        )
    if modifier.type in DEFORMING_TYPES:
        return ModifierEffect.DEFORMS
    return ModifierEffect.GENERATES if modifier.type in TOPOLOGY_CHANGING_TYPES else ModifierEffect.NEUTRAL


def time_dependence(modifier: bpy.types.Modifier) -> str:
    """Describe how a modifier depends on time, as a verb phrase; empty if it does not."""
    if modifier.type == "NODES":
        node = find_time_node(modifier.node_group)
        return f"changes with time (node '{node.name}' of '{node.id_data.name}')" if node else ""
    if effect_of(modifier) is ModifierEffect.NEUTRAL:
        return ""
    return TIME_DEPENDENT_TYPES.get(modifier.type, "")


def is_unbound(modifier: bpy.types.Modifier) -> bool:
    """Return whether a modifier does nothing, because it has not been bound to a rest pose."""
    if modifier.type not in BIND_PROPERTIES or (
        modifier.type == "CORRECTIVE_SMOOTH" and modifier.rest_source != "BIND"
    ):
        return False
    return not getattr(modifier, BIND_PROPERTIES[modifier.type])


def reads_shape(modifier: bpy.types.Modifier) -> bool:
    """Return whether the result of a neutral modifier depends on the positions of the vertices.

    This is assumed of each type that is not known to depend on nothing but weights, UV maps and transforms.
    """
    if modifier.type == "NODES":
        tree = modifier.node_group
        return tree is not None and (depends_on_shape(tree) or "position" in _node_input_texts(modifier))
    if modifier.type in {"VERTEX_WEIGHT_EDIT", "VERTEX_WEIGHT_MIX", "VERTEX_WEIGHT_PROXIMITY"}:
        if modifier.mask_texture is not None and modifier.mask_tex_mapping != "UV":
            return True
        return modifier.type == "VERTEX_WEIGHT_PROXIMITY" and modifier.proximity_mode == "GEOMETRY"
    if modifier.type == "DATA_TRANSFER":
        mappings = {
            getattr(modifier, f"{kind}_mapping")
            for kind in ("vert", "edge", "loop", "poly")
            if getattr(modifier, f"use_{kind}_data")
        }
        return modifier.object is not None and not mappings <= {"TOPOLOGY"}
    return not {
        "COLLISION": lambda: not modifier.settings.use,
        "DYNAMIC_PAINT": lambda: not (modifier.canvas_settings or modifier.brush_settings),
        "FLUID": lambda: modifier.fluid_type == "NONE",
        "TRIANGULATE": lambda: True,
        "UV_PROJECT": lambda: not any(projector.object for projector in modifier.projectors),
        "UV_WARP": lambda: True,
    }.get(modifier.type, lambda: False)()


def written_names(modifier: bpy.types.Modifier) -> set[str] | None:
    """Return the names of the vertex groups and attributes that a neutral modifier writes; None if it writes more."""
    if modifier.type == "NODES":
        return stored_attributes(modifier.node_group)
    if modifier.type == "DATA_TRANSFER":
        writes_weights = modifier.use_vert_data and modifier.data_types_verts == {"VGROUP_WEIGHTS"}
        writes_more = modifier.use_edge_data or modifier.use_loop_data or modifier.use_poly_data
        return set(modifier.id_data.vertex_groups.keys()) if writes_weights and not writes_more else None
    if modifier.type == "VERTEX_WEIGHT_MIX":
        return {modifier.vertex_group_a}
    return {modifier.vertex_group} if modifier.type in {"VERTEX_WEIGHT_EDIT", "VERTEX_WEIGHT_PROXIMITY"} else None


def read_names(modifier: bpy.types.Modifier) -> set[str]:
    """Return the names of the vertex groups and attributes that a modifier may read."""
    structs = [modifier, modifier.particle_system] if modifier.type == "PARTICLE_SYSTEM" else [modifier]
    names = {
        getattr(struct, prop.identifier)
        for struct in structs
        for prop in struct.bl_rna.properties
        if prop.type == "STRING" and prop.identifier != "name"
    }
    if modifier.type == "ARMATURE" and modifier.use_vertex_groups:
        names |= set(modifier.id_data.vertex_groups.keys())
    if modifier.type == "NODES" and modifier.node_group is not None:
        names |= named_attributes(modifier.node_group) | _node_input_texts(modifier)
    return names - {""}


def _node_input_texts(modifier: bpy.types.NodesModifier) -> set[str]:
    """Return the texts in the inputs of Geometry Nodes, among them the names of the attributes that inputs read."""
    sockets = [s for s in modifier.node_group.interface.items_tree if s.item_type == "SOCKET" and s.in_out == "INPUT"]
    settings = [node_input_settings(modifier, socket.identifier).values() for socket in sockets]
    return {value for values in settings for _, value in values if isinstance(value, str)}
