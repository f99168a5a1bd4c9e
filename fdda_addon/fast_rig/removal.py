# SPDX-License-Identifier: GPL-3.0-or-later
"""Removes everything from the open file that chosen joints, controls and shown objects do not need."""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import bpy

from ..core.errors import RigError
from ..rig.modifier_stack import deforming_modifiers, recorded_modifiers
from ..rig.references import Node, bones_of_modifier, deforming_bones, drivers_of, is_armature
from ..scene.action_slots import curves_of_actions
from ..scene.controls import canonical_path
from ..scene.scene_rig import SceneRig
from .graph_reader import read_graph, shown_objects
from .pruning import check_armature, remove_bones, remove_drivers, remove_objects


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
