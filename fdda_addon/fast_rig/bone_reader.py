# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads what bones need, and which bones deform objects."""

from collections.abc import Iterator

import bpy

from .dependency_graph import DependencyGraph, Node, chain_members
from .struct_reader import bone_node, datablock_node, is_armature, struct_needs

_CHAIN_CONSTRAINTS = {"IK", "SPLINE_IK"}
_ARMATURE_MODIFIERS = {"ARMATURE", "GREASE_PENCIL_ARMATURE"}
_HANDLES = ("bbone_custom_handle_start", "bbone_custom_handle_end")


def add_bones(
    graph: DependencyGraph, armature_object: bpy.types.Object, animated_paths: set[str], straight: frozenset[str]
) -> None:
    """Add what each bone of an armature object needs, except for drivers.

    Args:
        animated_paths: RNA paths of the armature object that actions or drivers set. A muted constraint counts unless
            its mute state is constant.
        straight: names of the bones that need no handles, because nothing reads their curve.
    """
    parents = {bone.name: bone.parent.name if bone.parent else "" for bone in armature_object.data.bones}
    for pose_bone in armature_object.pose.bones:
        node = bone_node(armature_object, pose_bone.name)
        is_straight = pose_bone.name in straight
        graph.add(node, datablock_node(armature_object))
        graph.add(node, *struct_needs(pose_bone, "child", "constraints", *(_HANDLES if is_straight else ())))
        bone = pose_bone.bone
        if bone.bbone_segments > 1 and bone.bbone_handle_type_end == "AUTO" and not is_straight:
            graph.add(node, *(bone_node(armature_object, child.name) for child in bone.children if child.use_connect))
        for constraint in pose_bone.constraints:
            path = constraint.path_from_id()
            if constraint.mute and not {f"{path}.mute", f"{path}.enabled"} & animated_paths:
                continue
            graph.add(node, *struct_needs(constraint))
            if constraint.type in _CHAIN_CONSTRAINTS:
                use_tail = getattr(constraint, "use_tail", True)
                members = chain_members(parents, pose_bone.name, constraint.chain_count, use_tail)
                graph.add_chain(bone_node(armature_object, name) for name in members)


def deforming_bones(
    scene_object: bpy.types.Object, armature_object: bpy.types.Object, use_envelopes: bool = False
) -> Iterator[Node]:
    """Yield the bones with which an armature object deforms an object: those of its vertex groups, or all."""
    group_names = {group.name for group in scene_object.vertex_groups}
    for bone in armature_object.data.bones:
        if bone.use_deform and (use_envelopes or not group_names or bone.name in group_names):
            yield bone_node(armature_object, bone.name)


def bones_of_modifier(scene_object: bpy.types.Object, modifier: bpy.types.Modifier) -> Iterator[Node]:
    """Yield the bones with which an Armature modifier deforms a mesh, a curve, a lattice or a Grease Pencil object."""
    if modifier.type in _ARMATURE_MODIFIERS and is_armature(modifier.object):
        yield from deforming_bones(scene_object, modifier.object, modifier.use_bone_envelopes)
