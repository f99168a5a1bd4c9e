# SPDX-License-Identifier: GPL-3.0-or-later
"""Tells what one modifier does to a mesh: whether it moves vertices, changes the topology or depends on time."""

from enum import Enum, auto

import bpy

from ..scene.node_groups import GeometryEffect, find_time_node, geometry_effect

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
