# SPDX-License-Identifier: GPL-3.0-or-later
"""Removes bones, drivers, objects and modifiers from the open file."""

from collections.abc import Iterator
from contextlib import contextmanager

import bpy

from ..core.errors import RigError
from ..rig.references import (
    Node,
    driven_node,
    driver_references,
    drivers_of,
    is_segment_path,
    references,
    split_bone_path,
)
from ..scene.scene_rig import SceneRig
from ..scene.temporary_state import temporary_attributes


def remove_bones(armature_object: bpy.types.Object, kept: set[Node]) -> list[str]:
    """Remove the bones of an armature object that are not kept, with their drivers; return their names.

    The kept bones keep their order, their transforms and their collections. `check_armature` tells whether this can be
    done.
    """
    names = [bone.name for bone in armature_object.data.bones if Node(armature_object, bone.name) not in kept]
    if not names:
        return []
    removed = {Node(armature_object, name) for name in names}
    for bone in armature_object.pose.bones:
        for constraint in [c for c in bone.constraints if c.mute and not removed.isdisjoint(references(c))]:
            bone.constraints.remove(constraint)
    with _edit_mode(armature_object):
        edit_bones = armature_object.data.edit_bones
        for name in names:
            edit_bones.remove(edit_bones[name])
    return names


def remove_drivers(
    scene_rigs: list[SceneRig], graph_nodes: set[Node], kept: set[Node], straight: frozenset[str]
) -> int:
    """Remove the drivers that set or read something that is not kept; return their number.

    Of the shape keys, modifiers and B-Bone segments that a model replaces, all drivers are removed that nothing needs.

    Args:
        scene_rigs: the rigs of the models.
        graph_nodes: all nodes of the dependency graph.
        straight: names of the bones whose segments are removed.
    """
    armature_object = scene_rigs[0].armature_object
    removed = graph_nodes - kept
    shape_keys = {rig.mesh_object.data.shape_keys for rig in scene_rigs}
    mesh_objects = {rig.mesh_object for rig in scene_rigs}
    count = 0
    for datablock in list(bpy.data.user_map()):
        for owner, curve in drivers_of(datablock):
            node = driven_node(owner, curve.data_path)
            bone_name = split_bone_path(owner, curve.data_path)[0]
            is_replaced = datablock in shape_keys or (datablock in mesh_objects and "modifiers[" in curve.data_path)
            if datablock in {armature_object, armature_object.data}:
                is_replaced = is_segment_path(datablock, curve.data_path, straight)
            sets_removed = bone_name and Node(datablock, bone_name) in removed
            needed = (node for node in driver_references(curve.driver) if not node.driven_path)
            reads_removed = not removed.isdisjoint(needed)
            if sets_removed or (node not in kept and (is_replaced or reads_removed)):
                owner.animation_data.drivers.remove(curve)
                count += 1
    return count


def remove_objects(kept: set[Node]) -> list[str]:
    """Remove the objects of the scene that are not kept; return their names."""
    removed = [o for o in bpy.context.scene.objects if Node(o) not in kept]
    names = [scene_object.name for scene_object in removed]
    bpy.data.batch_remove(removed)
    return names


def check_armature(armature_object: bpy.types.Object) -> None:
    """Raise a RigError if bones of an armature cannot be removed: it is linked, or other objects use it too."""
    armature = armature_object.data
    if armature_object.library or armature.library or armature_object.override_library or armature.override_library:
        raise RigError(
            f"The armature of '{armature_object.name}' comes from a library, so its bones cannot be removed here; give "
            "the file that contains the rig."
        )
    others = [o.name for o in bpy.data.objects if o.data == armature and o != armature_object]
    if others:
        raise RigError(
            f"'{others[0]}' uses the armature of '{armature_object.name}' too, and would lose its bones; make the "
            "armature single-user, or remove the object."
        )


@contextmanager
def _edit_mode(armature_object: bpy.types.Object) -> Iterator[None]:
    """Enter the edit mode of an armature object, also if the object is hidden."""
    view_layer, scene = bpy.context.view_layer, bpy.context.scene
    if view_layer.objects.active is not None and view_layer.objects.active.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    is_in_root = armature_object.name in scene.collection.objects
    if not is_in_root:
        # Its own collections may be hidden or excluded.
        scene.collection.objects.link(armature_object)
    was_hidden, active = armature_object.hide_get(), view_layer.objects.active
    try:
        armature_object.hide_set(False)
        view_layer.objects.active = armature_object
        with temporary_attributes(armature_object, hide_viewport=False):
            bpy.ops.object.mode_set(mode="EDIT")
            try:
                yield
            finally:
                bpy.ops.object.mode_set(mode="OBJECT")
    finally:
        view_layer.objects.active = active
        armature_object.hide_set(was_hidden)
        if not is_in_root:
            scene.collection.objects.unlink(armature_object)
