# SPDX-License-Identifier: GPL-3.0-or-later
"""Removes everything from the open file that chosen joints, controls and shown objects do not need."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import bpy

from ..core.errors import RigError
from ..rig.modifier_stack import deforming_modifiers, recorded_modifiers
from ..rig.references import (
    Node,
    bones_of_modifier,
    deforming_bones,
    driven_node,
    driver_references,
    drivers_of,
    is_armature,
    is_segment_path,
    references,
    split_bone_path,
)
from ..scene.action_slots import curves_of_actions
from ..scene.controls import canonical_path
from ..scene.scene_rig import SceneRig
from ..scene.temporary_state import temporary_attributes
from .graph_reader import read_graph, shown_objects


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
    readers = [o for o in bpy.data.objects if Node(o) in kept]
    read = {
        node
        for scene_object in readers
        for node in _bones_with_read_curves(
            scene_object, None if scene_object.library else replaced_modifiers.get(scene_object.name), kept
        )
    }
    bones = (bone for bone in armature_object.data.bones if bone.bbone_segments > 1)
    return frozenset({b.name for b in bones if Node(armature_object, b.name) not in read} - set(controls))


def _bones_with_read_curves(
    scene_object: bpy.types.Object, replaced: set[str] | None, kept: set[Node]
) -> Iterator[Node]:
    """Yield the bones whose curve deforms an object, or is followed by constraints of it or of its kept bones.

    Args:
        replaced: names of the modifiers that a model of the object replaces; None if it has no model.
    """
    for modifier in scene_object.modifiers:
        if modifier.name not in (replaced or ()):
            yield from bones_of_modifier(scene_object, modifier)
    if replaced is None and is_armature(scene_object.parent) and scene_object.parent_type == "ARMATURE":
        yield from deforming_bones(scene_object, scene_object.parent)
    bones = scene_object.pose.bones if scene_object.pose else ()
    owners = [scene_object, *(bone for bone in bones if Node(scene_object, bone.name) in kept)]
    for constraint in (constraint for owner in owners for constraint in owner.constraints):
        targets = constraint.targets if constraint.type == "ARMATURE" else ()
        if getattr(constraint, "use_bbone_shape", False):
            targets = [constraint]
        yield from (Node(t.target, t.subtarget) for t in targets if t.target is not None)


class Removed(NamedTuple):
    """What was removed: the names, and the number of drivers."""

    bones: set[str]
    objects: tuple[str, ...]
    modifiers: tuple[str, ...]
    drivers: int


def remove_unneeded(
    scene_rigs: list[SceneRig], joint_names: Iterable[str], controls: Iterable[str], nodes: Iterable[Node] = ()
) -> Removed:
    """Remove everything that joints, controls, shown objects and other nodes do not need, and the replaced modifiers.

    The first Armature modifier stays, because it tells which armature a mesh has. So do modifiers whose settings
    something kept reads; they are off, as in the full rig while a model plays. All actions stay.

    Args:
        scene_rigs: the rigs whose meshes models deform; they share one armature object.
        joint_names: names of the joints that the models read.
        controls: names of the control bones to keep.
        nodes: further nodes to keep.
    """
    armature_object = scene_rigs[0].armature_object
    check_armature(armature_object)
    for action in (action for action in bpy.data.actions if action.library is None):
        # Saving would drop the actions that only removed objects and constraints use.
        action.use_fake_user = True
    # Write names into the paths of drivers and actions, because removing elements changes the numbers of others.
    for datablock in bpy.data.user_map():
        for owner, curve in drivers_of(datablock) if datablock.library is None else ():
            _write_names(curve, owner)
            for target in (target for variable in curve.driver.variables for target in variable.targets):
                _write_names(target, bpy.context.scene if target.id is None else target.id)
    roots = (scene_rigs[0].armature_object, *(rig.mesh_object for rig in scene_rigs))
    actions = [action for action in bpy.data.actions if action.library is None]
    for curves_by_datablock in curves_of_actions(actions, *roots):
        for datablock, curves in curves_by_datablock.items():
            for curve in curves:
                _write_names(curve, datablock)
    shown = [*shown_objects(scene_rigs), armature_object, *(rig.mesh_object for rig in scene_rigs)]
    worlds = [scene.world for scene in bpy.data.scenes if scene.world is not None]
    roots = [*map(Node, (*shown, *bpy.data.scenes, *worlds)), *nodes]
    roots += [Node(armature_object, name) for name in (*joint_names, *controls)]
    # A model replaces these modifiers, on or off.
    replaced = {
        o.name: {m.name for m in (*deforming_modifiers(o), *recorded_modifiers(o))}
        for o in (rig.mesh_object for rig in scene_rigs)
    }
    kept_with_curves = read_graph(scene_rigs, replaced).kept(roots)
    straight = unread_curves(armature_object, replaced, controls, kept_with_curves)
    graph = read_graph(scene_rigs, replaced, straight)
    kept = graph.kept(roots)
    for scene_rig in scene_rigs:
        replaced[scene_rig.mesh_object.name] -= _read_modifiers(scene_rig.mesh_object, kept)
    drivers = remove_drivers(scene_rigs, graph.nodes, kept, straight)
    for name in straight:
        armature_object.data.bones[name].bbone_segments = 1
    # Before the bones, whose loss Blender would report for each removed object that needs them.
    objects = remove_objects(kept)
    bones = set(remove_bones(armature_object, kept))
    modifiers = []
    for mesh_object in (rig.mesh_object for rig in scene_rigs):
        names = [modifier.name for modifier in mesh_object.modifiers if modifier.name in replaced[mesh_object.name]]
        first_armature = next((name for name in names if mesh_object.modifiers[name].type == "ARMATURE"), None)
        removed = [name for name in names if name != first_armature]
        for name in removed:
            mesh_object.modifiers.remove(mesh_object.modifiers[name])
        modifiers += removed
    return Removed(bones, tuple(objects), tuple(modifiers), drivers)


def _write_names(owner: bpy.types.FCurve | bpy.types.DriverTarget, datablock: bpy.types.ID) -> None:
    path = canonical_path(datablock, owner.data_path)
    if path != owner.data_path:
        owner.data_path = path


def _read_modifiers(mesh_object: bpy.types.Object, kept: set[Node]) -> set[str]:
    """Return the names of the modifiers of an object whose settings kept drivers read."""
    paths = [node.driven_path for node in kept if node.datablock == mesh_object]
    read = set()
    for modifier in mesh_object.modifiers:
        prefix = modifier.path_from_id()
        if {f"{prefix}.show_viewport", f"{prefix}.show_render"} & set(paths):
            raise RigError(
                f"A driver reads if the modifier '{modifier.name}' of '{mesh_object.name}' is on, but a model turns it "
                "off; let the driver read another property."
            )
        if any(path.startswith(f"{prefix}.") for path in paths):
            read.add(modifier.name)
    return read


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
