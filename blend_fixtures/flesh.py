# SPDX-License-Identifier: GPL-3.0-or-later
"""Flesh that Blender simulates: a copy of a character that sags and bulges, for it to learn from."""

from collections.abc import Collection

import bpy

FLESH = "flesh"
GOAL = 0.9
"""How strongly flesh is held where it sags."""


def keep_armature_modifier(mesh_object: bpy.types.Object) -> None:
    """Remove all modifiers of a mesh but the Armature: what is left is linear skinning."""
    for modifier in [m for m in mesh_object.modifiers if m.type != "ARMATURE"]:
        mesh_object.modifiers.remove(modifier)


def add_flesh(mesh_object: bpy.types.Object) -> bpy.types.Object:
    """Leave a mesh its Armature modifier alone, and add a copy of it to the scene; returns the copy."""
    keep_armature_modifier(mesh_object)
    flesh = mesh_object.copy()
    flesh.data, flesh.name = mesh_object.data.copy(), FLESH
    bpy.context.scene.collection.objects.link(flesh)
    return flesh


def make_soft_body(flesh: bpy.types.Object, fleshy: Collection[str]) -> None:
    """Springs along the edges and across the faces, goals at the skin of the bones.

    Without springs across, faces shear and edges buckle, this way or that: neither flesh nor a function of the pose.

    Args:
        flesh: a mesh with an Armature modifier.
        fleshy: the bones whose vertices sag and bulge; those of others are held.
    """
    soft_groups = {flesh.vertex_groups[name].index for name in fleshy}
    held = flesh.vertex_groups.new(name="held")
    for vertex in flesh.data.vertices:
        weights = {element.group: element.weight for element in vertex.groups}
        soft = sum(weights.get(index, 0.0) for index in soft_groups) / sum(weights.values())
        held.add([vertex.index], 1 - (1 - GOAL) * soft, "REPLACE")
    flesh.modifiers.new("Softbody", "SOFT_BODY")
    soft_body = flesh.soft_body
    soft_body.use_goal, soft_body.goal_default, soft_body.vertex_group_goal = True, 1.0, held.name
    soft_body.goal_spring, soft_body.goal_friction, soft_body.mass = GOAL, 30.0, 0.3
    soft_body.use_edges, soft_body.pull, soft_body.push, soft_body.damping, soft_body.bend = True, 0.3, 0.3, 50.0, 0.2
    soft_body.use_stiff_quads, soft_body.shear = True, 0.5


def make_cloth(flesh: bpy.types.Object) -> None:
    """Cloth that is pinned by half everywhere: gravity and the stretch of its edges do the rest."""
    pin = flesh.vertex_groups.new(name="pin")
    pin.add(range(len(flesh.data.vertices)), 0.5, "REPLACE")
    settings = flesh.modifiers.new("Cloth", "CLOTH").settings
    settings.vertex_group_mass, settings.quality, settings.air_damping = "pin", 5, 10.0
