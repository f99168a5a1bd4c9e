# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the B-Bones whose curve nothing reads any more once a model deforms the mesh."""

from collections.abc import Iterable, Iterator

import bpy

from .bone_reader import bone_node, datablock_node, deforming_bones, is_armature
from .dependency_graph import Node


def unread_curves(
    armature_object: bpy.types.Object,
    mesh_objects: Iterable[bpy.types.Object],
    controls: Iterable[str],
    kept: set[Node],
) -> frozenset[str]:
    """Return the names of the bones with several segments whose curve only the replaced Armature modifiers read.

    A model reads the transforms of its joints, which the segments do not change.

    Args:
        armature_object: the armature object.
        mesh_objects: the objects that models deform.
        controls: names of the bones that animators see.
        kept: what is kept if all segments stay; the objects and bones that are not kept read no curve.
    """
    models = set(mesh_objects)
    readers = [o for o in bpy.data.objects if o not in models and datablock_node(o) in kept]
    read = {node for scene_object in readers for node in _bones_with_read_curves(scene_object, kept)}
    bones = (bone for bone in armature_object.data.bones if bone.bbone_segments > 1)
    return frozenset({b.name for b in bones if bone_node(armature_object, b.name) not in read} - set(controls))


def _bones_with_read_curves(scene_object: bpy.types.Object, kept: set[Node]) -> Iterator[Node]:
    """Yield the bones whose curve deforms an object, or is followed by constraints of it or of its kept bones."""
    for modifier in scene_object.modifiers:
        if modifier.type == "ARMATURE" and modifier.object is not None:
            yield from deforming_bones(scene_object, modifier.object, modifier.use_bone_envelopes)
    if is_armature(scene_object.parent) and scene_object.parent_type == "ARMATURE":
        yield from deforming_bones(scene_object, scene_object.parent)
    bones = scene_object.pose.bones if scene_object.pose else ()
    owners = [scene_object, *(bone for bone in bones if bone_node(scene_object, bone.name) in kept)]
    for constraint in (constraint for owner in owners for constraint in owner.constraints):
        targets = constraint.targets if constraint.type == "ARMATURE" else ()
        if getattr(constraint, "use_bbone_shape", False):
            targets = [constraint]
        yield from (bone_node(t.target, t.subtarget) for t in targets if t.target is not None)
