# SPDX-License-Identifier: GPL-3.0-or-later
"""Build characters with the kinds of weights and Armature modifiers that riggers use; each function builds one.

All functions build in the current scene. Tubes have the object names of `base`, limbs the object names of `bones`.
"""

import bpy
import numpy as np

from .base import link, tube
from .bones import NewBone, add_bones, add_delta_mush, add_smooth_weights, limb, limit


def smooth_weights() -> None:
    """Build a limb with only smooth weights and an Armature modifier."""
    mesh_object, armature_object = limb(4)
    add_smooth_weights(mesh_object, armature_object, 4, 0.1)


def many_influences() -> None:
    """Build a limb with seven bones per vertex and delta mush."""
    mesh_object, armature_object = limb(10, degrees=20.0)
    add_smooth_weights(mesh_object, armature_object, 7, 0.12)
    add_delta_mush(mesh_object)


def unnormalized() -> None:
    """Build a tube whose weights sum to between 0.1 and 2, with delta mush."""
    mesh_object, _ = tube()
    for vertex in mesh_object.data.vertices:
        factor = 0.1 + 1.9 * (vertex.index * 7 % 10) / 9
        for element in vertex.groups:
            element.weight = element.weight * factor
    add_delta_mush(mesh_object)


def partly_missing() -> None:
    """Build a tube with delta mush; a patch at its start has no weights and does not move."""
    mesh_object, _ = tube()
    unweighted_vertices = [
        vertex.index for vertex in mesh_object.data.vertices if vertex.co.x < 0.07 and vertex.co.z > 0.0
    ]
    for group in mesh_object.vertex_groups:
        group.remove(unweighted_vertices)
    add_delta_mush(mesh_object)


def preserve_volume() -> None:
    """Build a limb with Preserve Volume (dual quaternion skinning)."""
    mesh_object, armature_object = limb(3, degrees=40.0, twist=60.0)
    add_smooth_weights(mesh_object, armature_object, 3, 0.12)
    mesh_object.modifiers["Armature"].use_deform_preserve_volume = True


def envelopes() -> None:
    """Build a limb with bone envelopes and without vertex groups."""
    mesh_object, armature_object = limb(3)
    widen_envelopes(armature_object)
    modifier = mesh_object.modifiers["Armature"]
    modifier.use_vertex_groups, modifier.use_bone_envelopes = False, True


def envelopes_where_groups_are_missing() -> None:
    """Build a limb with vertex groups at its start, bone envelopes elsewhere, and delta mush."""
    mesh_object, armature_object = limb(3)
    add_smooth_weights(mesh_object, armature_object, 3, 0.1)
    widen_envelopes(armature_object)
    unweighted_vertices = [vertex.index for vertex in mesh_object.data.vertices if vertex.co.x > 0.3]
    for group in mesh_object.vertex_groups:
        group.remove(unweighted_vertices)
    mesh_object.modifiers["Armature"].use_bone_envelopes = True
    add_delta_mush(mesh_object)


def widen_envelopes(armature_object: bpy.types.Object) -> None:
    """Enlarge the envelopes of a limb so that they contain its surface."""
    for bone in armature_object.data.bones:
        bone.head_radius = bone.tail_radius = 0.05
        bone.envelope_distance = 0.08


def b_bones() -> None:
    """Build a limb with bendy bones of six segments."""
    mesh_object, armature_object = limb(3)
    add_smooth_weights(mesh_object, armature_object, 2, 0.08)
    for bone in armature_object.data.bones:
        bone.bbone_segments = 6


def masked() -> None:
    """Build a limb with delta mush; a vertex group of the Armature modifier reduces the motion of its start."""
    mesh_object, armature_object = limb(3)
    add_smooth_weights(mesh_object, armature_object, 3, 0.1)
    group = mesh_object.vertex_groups.new(name="mask")
    for vertex in mesh_object.data.vertices:
        if (weight := float(np.clip(vertex.co.x / 0.15, 0.0, 1.0))) > 0.0:
            group.add([vertex.index], weight, "REPLACE")
    mesh_object.modifiers["Armature"].vertex_group = "mask"
    add_delta_mush(mesh_object)


def multi_modifier() -> None:
    """Build a limb with two Armature modifiers on one armature, which blend Preserve Volume with linear skinning."""
    mesh_object, armature_object = limb(3, twist=60.0)
    add_smooth_weights(mesh_object, armature_object, 3, 0.1)
    group = mesh_object.vertex_groups.new(name="volume")
    for vertex in mesh_object.data.vertices:
        group.add([vertex.index], float(0.5 + 0.5 * np.sin(vertex.co.x * 30.0)), "REPLACE")
    second_modifier = mesh_object.modifiers.new("Volume", "ARMATURE")
    second_modifier.object, second_modifier.vertex_group = armature_object, "volume"
    second_modifier.use_deform_preserve_volume = second_modifier.use_multi_modifier = True


def two_armatures() -> None:
    """Build a tube with two Armature modifiers, for the armature of the body and for the armature of the muscles."""
    mesh_object, _ = tube()
    muscles = link(bpy.data.objects.new("muscle_rig", bpy.data.armatures.new("muscle_rig")))
    add_bones(muscles, NewBone("muscle", (0.1, 0.0, 0.0), (0.1, 0.0, 0.1)))
    limit(muscles.pose.bones["muscle"], "LIMIT_ROTATION", {0: (-20.0, 20.0), 2: (-20.0, 20.0)})
    group = mesh_object.vertex_groups.new(name="muscle")
    for vertex in mesh_object.data.vertices:
        if (weight := float(np.exp(-(((vertex.co.x - 0.1) / 0.05) ** 2)))) > 0.05:
            group.add([vertex.index], weight, "REPLACE")
    second_modifier = mesh_object.modifiers.new("Muscles", "ARMATURE")
    second_modifier.object, second_modifier.vertex_group = muscles, "muscle"


def non_deforming_bones() -> None:
    """Build a limb with delta mush and with non-deforming bones among the deforming bones; they have vertex groups."""
    mesh_object, armature_object = limb(5)
    for name in ("bone.0", "bone.2"):
        armature_object.data.bones[name].use_deform = False
    add_smooth_weights(mesh_object, armature_object, 3, 0.12)
    ignored_group = mesh_object.vertex_groups.new(name="bone.2")
    ignored_group.add(range(len(mesh_object.data.vertices)), 0.7, "REPLACE")
    add_delta_mush(mesh_object)


def scaled_bones() -> None:
    """Build a limb with delta mush whose bones scale within a Limit Scale in local space."""
    mesh_object, armature_object = limb(3)
    add_smooth_weights(mesh_object, armature_object, 3, 0.1)
    for bone in armature_object.pose.bones:
        limit(bone, "LIMIT_SCALE", {0: (0.7, 1.4), 1: (0.8, 1.2), 2: (0.7, 1.4)})
    add_delta_mush(mesh_object)


def stretched() -> None:
    """Build a tube with delta mush; a bone stretches to a control bone that moves within a Limit Location."""
    mesh_object, armature_object = tube()
    add_bones(armature_object, NewBone("target", (0.5, 0.0, 0.0), (0.55, 0.0, 0.0), "upper", is_deforming=False))
    limit(armature_object.pose.bones["target"], "LIMIT_LOCATION", {axis: (-0.12, 0.12) for axis in range(3)})
    stretch_constraint = armature_object.pose.bones["lower"].constraints.new("STRETCH_TO")
    stretch_constraint.target, stretch_constraint.subtarget, stretch_constraint.rest_length = (
        armature_object,
        "target",
        0.25,
    )
    add_delta_mush(mesh_object)
