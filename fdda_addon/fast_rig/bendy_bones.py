# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the B-Bones whose curve nothing reads any more once a model deforms the mesh."""

from collections.abc import Iterable, Iterator

import bpy

from .bone_reader import bones_of_modifier, deforming_bones
from .dependency_graph import Node
from .struct_reader import bone_node, datablock_node, is_armature


def unread_curves(
    armature_object: bpy.types.Object,
    replaced_modifiers: dict[str, set[str]],
    controls: Iterable[str],
    kept: set[Node],
) -> frozenset[str]:
    """Return the names of the bones with several segments whose curve only the replaced Armature modifiers read.

    A model reads the transforms of its joints, which the segments do not change.

    Args:
        replaced_modifiers: names of the modifiers that a model replaces, by name of the mesh object.
        controls: names of the bones that animators see.
        kept: what is kept if all segments stay; the objects and bones that are not kept read no curve.
    """
    readers = [o for o in bpy.data.objects if datablock_node(o) in kept]
    read = {
        node
        for scene_object in readers
        for node in _bones_with_read_curves(
            scene_object, None if scene_object.library else replaced_modifiers.get(scene_object.name), kept
        )
    }
    bones = (bone for bone in armature_object.data.bones if bone.bbone_segments > 1)
    return frozenset({b.name for b in bones if bone_node(armature_object, b.name) not in read} - set(controls))


def _bones_with_read_curves(
    scene_object: bpy.types.Object, replaced: set[str] | None, kept: set[Node]
) -> Iterator[Node]:
    """Yield the bones whose curve deforms an object, or is followed by constraints of it or of its kept bones.

    Args:
        replaced: names of the modifiers that a model of the object replaces; None if it has no model.
        kept: the kept nodes.
    """
    for modifier in scene_object.modifiers:
        if modifier.name not in (replaced or ()):
            yield from bones_of_modifier(scene_object, modifier)
    if replaced is None and is_armature(scene_object.parent) and scene_object.parent_type == "ARMATURE":
        yield from deforming_bones(scene_object, scene_object.parent)
    bones = scene_object.pose.bones if scene_object.pose else ()
    owners = [scene_object, *(bone for bone in bones if bone_node(scene_object, bone.name) in kept)]
    for constraint in (constraint for owner in owners for constraint in owner.constraints):
        targets = constraint.targets if constraint.type == "ARMATURE" else ()
        if getattr(constraint, "use_bbone_shape", False):
            targets = [constraint]
        yield from (bone_node(t.target, t.subtarget) for t in targets if t.target is not None)
