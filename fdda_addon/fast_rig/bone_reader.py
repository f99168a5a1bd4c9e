# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads what bones need: parents, constraints, IK chains, B-Bone handles and custom shapes."""

from collections.abc import Iterator

import bpy

from .dependency_graph import DependencyGraph, Node, chain_members, datablock_key

_SUBTARGETS = {"target": "subtarget", "pole_target": "pole_subtarget", "space_object": "space_subtarget"}
"""Property of a constraint or of a modifier that names a bone, by the property that points to its object."""
_CHAIN_CONSTRAINTS = {"IK", "SPLINE_IK"}
_ARMATURE_MODIFIERS = {"ARMATURE", "GREASE_PENCIL_ARMATURE"}


def datablock_node(datablock: bpy.types.ID) -> Node:
    """Return the node of a datablock."""
    library = datablock.library.filepath if datablock.library else ""
    return Node(datablock_key(datablock.id_type, datablock.name, library))


def bone_node(armature_object: bpy.types.Object, bone_name: str) -> Node:
    """Return the node of a bone of an armature object."""
    return Node(datablock_node(armature_object).datablock, bone=bone_name)


def add_bones(
    graph: DependencyGraph, armature_object: bpy.types.Object, animated_paths: set[str], straight: frozenset[str]
) -> None:
    """Add what each bone of an armature object needs, except for drivers.

    Args:
        graph: the graph.
        armature_object: the armature object.
        animated_paths: RNA paths of the armature object that actions or drivers set. A muted constraint counts unless
            its mute state is constant.
        straight: names of the bones that need no handles, because nothing reads their curve.
    """
    parents = {bone.name: bone.parent.name if bone.parent else "" for bone in armature_object.data.bones}
    for pose_bone in armature_object.pose.bones:
        node = bone_node(armature_object, pose_bone.name)
        graph.add(node, datablock_node(armature_object))
        if parents[pose_bone.name]:
            graph.add(node, bone_node(armature_object, parents[pose_bone.name]))
        graph.add(node, *_shape_needs(armature_object, pose_bone))
        if pose_bone.name not in straight:
            graph.add(node, *_handle_needs(armature_object, pose_bone.bone))
        for constraint in pose_bone.constraints:
            path = constraint.path_from_id()
            if constraint.mute and not {f"{path}.mute", f"{path}.enabled"} & animated_paths:
                continue
            graph.add(node, *constraint_needs(constraint))
            if constraint.type in _CHAIN_CONSTRAINTS:
                use_tail = getattr(constraint, "use_tail", True)
                members = chain_members(parents, pose_bone.name, constraint.chain_count, use_tail)
                graph.add_chain(bone_node(armature_object, name) for name in members)


def constraint_needs(constraint: bpy.types.Constraint) -> Iterator[Node]:
    """Yield the datablocks and bones that a constraint of a bone or of an object reads."""
    yield from pointer_needs(constraint)
    for target in getattr(constraint, "targets", ()):
        yield from pointer_needs(target)


def pointer_needs(struct: bpy.types.bpy_struct) -> Iterator[Node]:
    """Yield the datablocks to which the properties of a constraint or of a modifier point, each with its bone."""
    for prop in struct.bl_rna.properties:
        value = getattr(struct, prop.identifier) if prop.type == "POINTER" else None
        if not isinstance(value, bpy.types.ID):
            continue
        yield datablock_node(value)
        # Most structs name the bone `subtarget`, also where the object is not their `target`.
        name = getattr(struct, _SUBTARGETS.get(prop.identifier, "subtarget"), "")
        if name and is_armature(value) and name in value.data.bones:
            yield bone_node(value, name)


def is_armature(datablock: bpy.types.ID | None) -> bool:
    """Return whether a datablock is an armature object."""
    return isinstance(datablock, bpy.types.Object) and datablock.type == "ARMATURE"


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


def _shape_needs(armature_object: bpy.types.Object, pose_bone: bpy.types.PoseBone) -> Iterator[Node]:
    """Yield what the custom shape of a bone needs."""
    if pose_bone.custom_shape is not None:
        yield datablock_node(pose_bone.custom_shape)
    if pose_bone.custom_shape_transform is not None:
        yield bone_node(armature_object, pose_bone.custom_shape_transform.name)


def _handle_needs(armature_object: bpy.types.Object, bone: bpy.types.Bone) -> Iterator[Node]:
    """Yield the bones that bend the B-Bone segments of a bone."""
    for handle in (bone.bbone_custom_handle_start, bone.bbone_custom_handle_end):
        if handle is not None:
            yield bone_node(armature_object, handle.name)
    if bone.bbone_segments > 1 and bone.bbone_handle_type_end == "AUTO":
        yield from (bone_node(armature_object, child.name) for child in bone.children if child.use_connect)
