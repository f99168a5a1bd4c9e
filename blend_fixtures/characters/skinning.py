# SPDX-License-Identifier: GPL-3.0-or-later
"""Characters whose weights and Armature modifiers are as riggers leave them: one function each.

Each builds in the current scene. Those of the tube are named as in `base`, those of the limb as in `bones`.
"""

from collections.abc import Callable

import bpy
import numpy as np

from .base import link, tube
from .bones import NewBone, add_bones, add_smooth_weights, limb, limit, mush


def smooth_weights() -> None:
    """Smooth weights and an Armature modifier alone."""
    mesh_object, armature_object = limb(4)
    add_smooth_weights(mesh_object, armature_object, 4, 0.1)


def many_influences() -> None:
    """Seven bones a vertex, and delta mush."""
    mesh_object, armature_object = limb(10, degrees=20.0)
    add_smooth_weights(mesh_object, armature_object, 7, 0.12)
    mush(mesh_object)


def unnormalized() -> None:
    """Weights that sum to anything between 0.1 and 2, and delta mush."""
    mesh_object, _ = tube()
    for vertex in mesh_object.data.vertices:
        factor = 0.1 + 1.9 * (vertex.index * 7 % 10) / 9
        for element in vertex.groups:
            element.weight = element.weight * factor
    mush(mesh_object)


def partly_missing() -> None:
    """A patch at the start of the tube has no weights and stays where it is; delta mush."""
    mesh_object, _ = tube()
    bare = [vertex.index for vertex in mesh_object.data.vertices if vertex.co.x < 0.07 and vertex.co.z > 0.0]
    for group in mesh_object.vertex_groups:
        group.remove(bare)
    mush(mesh_object)


def preserve_volume() -> None:
    """Preserve Volume: dual quaternions."""
    mesh_object, armature_object = limb(3, degrees=40.0, twist=60.0)
    add_smooth_weights(mesh_object, armature_object, 3, 0.12)
    mesh_object.modifiers["Armature"].use_deform_preserve_volume = True


def envelopes() -> None:
    """Bone envelopes and no vertex groups."""
    mesh_object, armature_object = limb(3)
    widen_envelopes(armature_object)
    modifier = mesh_object.modifiers["Armature"]
    modifier.use_vertex_groups, modifier.use_bone_envelopes = False, True


def envelopes_where_groups_are_missing() -> None:
    """Vertex groups near the joint, bone envelopes elsewhere, and delta mush."""
    mesh_object, armature_object = limb(3)
    add_smooth_weights(mesh_object, armature_object, 3, 0.1)
    widen_envelopes(armature_object)
    bare = [vertex.index for vertex in mesh_object.data.vertices if vertex.co.x > 0.3]
    for group in mesh_object.vertex_groups:
        group.remove(bare)
    mesh_object.modifiers["Armature"].use_bone_envelopes = True
    mush(mesh_object)


def widen_envelopes(armature_object: bpy.types.Object) -> None:
    """Let the envelopes of a limb reach over its surface."""
    for bone in armature_object.data.bones:
        bone.head_radius = bone.tail_radius = 0.05
        bone.envelope_distance = 0.08


def b_bones() -> None:
    """Bendy bones of six segments."""
    mesh_object, armature_object = limb(3)
    add_smooth_weights(mesh_object, armature_object, 2, 0.08)
    for bone in armature_object.data.bones:
        bone.bbone_segments = 6


def masked() -> None:
    """A vertex group in the Armature modifier lets the end of the limb stay behind, and delta mush."""
    mesh_object, armature_object = limb(3)
    add_smooth_weights(mesh_object, armature_object, 3, 0.1)
    group = mesh_object.vertex_groups.new(name="mask")
    for vertex in mesh_object.data.vertices:
        if (weight := float(np.clip(vertex.co.x / 0.15, 0.0, 1.0))) > 0.0:
            group.add([vertex.index], weight, "REPLACE")
    mesh_object.modifiers["Armature"].vertex_group = "mask"
    mush(mesh_object)


def multi_modifier() -> None:
    """Two Armature modifiers on one armature: Preserve Volume, blended into plain skinning near the joints."""
    mesh_object, armature_object = limb(3, twist=60.0)
    add_smooth_weights(mesh_object, armature_object, 3, 0.1)
    group = mesh_object.vertex_groups.new(name="volume")
    for vertex in mesh_object.data.vertices:
        group.add([vertex.index], float(0.5 + 0.5 * np.sin(vertex.co.x * 30.0)), "REPLACE")
    second = mesh_object.modifiers.new("Volume", "ARMATURE")
    second.object, second.vertex_group = armature_object, "volume"
    second.use_deform_preserve_volume = second.use_multi_modifier = True


def two_armatures() -> None:
    """Two Armature modifiers on two armatures: a body, and muscles that have a rig of their own."""
    mesh_object, _ = tube()
    muscles = link(bpy.data.objects.new("muscle_rig", bpy.data.armatures.new("muscle_rig")))
    add_bones(muscles, NewBone("muscle", (0.1, 0.0, 0.0), (0.1, 0.0, 0.1)))
    limit(muscles.pose.bones["muscle"], "LIMIT_ROTATION", {0: (-20.0, 20.0), 2: (-20.0, 20.0)})
    group = mesh_object.vertex_groups.new(name="muscle")
    for vertex in mesh_object.data.vertices:
        if (weight := float(np.exp(-(((vertex.co.x - 0.1) / 0.05) ** 2)))) > 0.05:
            group.add([vertex.index], weight, "REPLACE")
    second = mesh_object.modifiers.new("Muscles", "ARMATURE")
    second.object, second.vertex_group = muscles, "muscle"


def non_deforming_bones() -> None:
    """Bones that do not deform, with vertex groups of their own, above and between those that do; delta mush."""
    mesh_object, armature_object = limb(5)
    for name in ("bone.0", "bone.2"):
        armature_object.data.bones[name].use_deform = False
    add_smooth_weights(mesh_object, armature_object, 3, 0.12)
    ignored = mesh_object.vertex_groups.new(name="bone.2")
    ignored.add(range(len(mesh_object.data.vertices)), 0.7, "REPLACE")
    mush(mesh_object)


def scaled_bones() -> None:
    """Bones that grow and shrink within a Limit Scale in local space, and delta mush."""
    mesh_object, armature_object = limb(3)
    add_smooth_weights(mesh_object, armature_object, 3, 0.1)
    for bone in armature_object.pose.bones:
        limit(bone, "LIMIT_SCALE", {0: (0.7, 1.4), 1: (0.8, 1.2), 2: (0.7, 1.4)})
    mush(mesh_object)


def stretched() -> None:
    """A bone that stretches to a control bone, which moves within a Limit Location; delta mush."""
    mesh_object, armature_object = tube()
    add_bones(armature_object, NewBone("target", (0.5, 0.0, 0.0), (0.55, 0.0, 0.0), "upper", is_deforming=False))
    limit(armature_object.pose.bones["target"], "LIMIT_LOCATION", {axis: (-0.12, 0.12) for axis in range(3)})
    stretch = armature_object.pose.bones["lower"].constraints.new("STRETCH_TO")
    stretch.target, stretch.subtarget, stretch.rest_length = armature_object, "target", 0.25
    mush(mesh_object)


SKINNINGS: tuple[Callable[[], None], ...] = (
    smooth_weights, many_influences, unnormalized, partly_missing, preserve_volume, envelopes,
    envelopes_where_groups_are_missing, b_bones, masked, multi_modifier, two_armatures, non_deforming_bones,
    scaled_bones, stretched,
)  # fmt: skip
