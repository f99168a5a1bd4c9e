# SPDX-License-Identifier: GPL-3.0-or-later
"""Add flesh that Blender simulates: a copy of a character that sags and bulges, as the target of a recording."""

from collections.abc import Collection

import bpy

FLESH = "flesh"
SOFT_GOAL = 0.9
"""Goal weight of the soft parts, 0 to 1: a lower goal lets the flesh sag more."""


def keep_armature_modifier(mesh_object: bpy.types.Object) -> None:
    """Remove all modifiers of a mesh but the Armature, so that the mesh has only linear skinning."""
    for modifier in [m for m in mesh_object.modifiers if m.type != "ARMATURE"]:
        mesh_object.modifiers.remove(modifier)


def add_flesh(mesh_object: bpy.types.Object) -> bpy.types.Object:
    """Remove all modifiers of a mesh but the Armature, and add a copy of it to the scene; return the copy."""
    keep_armature_modifier(mesh_object)
    flesh = mesh_object.copy()
    flesh.data, flesh.name = mesh_object.data.copy(), FLESH
    bpy.context.scene.collection.objects.link(flesh)
    return flesh


def make_soft_body(flesh: bpy.types.Object, soft_bones: Collection[str]) -> None:
    """Add a soft body with springs along the edges and across the faces, and with the skinned surface as its goal.

    Without springs across the faces, faces shear and edges buckle at random. The result then does not look like flesh,
    and it is not a function of the pose.
    """
    soft_group_indices = {flesh.vertex_groups[name].index for name in soft_bones}
    goal_group = flesh.vertex_groups.new(name="held")
    for vertex in flesh.data.vertices:
        weights = {element.group: element.weight for element in vertex.groups}
        softness = sum(weights.get(index, 0.0) for index in soft_group_indices) / sum(weights.values())
        goal_group.add([vertex.index], 1 - (1 - SOFT_GOAL) * softness, "REPLACE")
    flesh.modifiers.new("Softbody", "SOFT_BODY")
    soft_body = flesh.soft_body
    soft_body.use_goal, soft_body.goal_default, soft_body.vertex_group_goal = True, 1.0, goal_group.name
    soft_body.goal_spring, soft_body.goal_friction, soft_body.mass = SOFT_GOAL, 30.0, 0.3
    soft_body.use_edges, soft_body.pull, soft_body.push, soft_body.damping, soft_body.bend = True, 0.3, 0.3, 50.0, 0.2
    soft_body.use_stiff_quads, soft_body.shear = True, 0.5


def make_cloth(flesh: bpy.types.Object) -> None:
    """Add a cloth simulation with a pin weight of one half, so that gravity and stretching edges move the mesh."""
    pin_group = flesh.vertex_groups.new(name="pin")
    pin_group.add(range(len(flesh.data.vertices)), 0.5, "REPLACE")
    settings = flesh.modifiers.new("Cloth", "CLOTH").settings
    settings.vertex_group_mass, settings.quality, settings.air_damping = "pin", 5, 10.0
