# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads the dependency graph of a file in which models play, and the objects that a fast rig shows."""

from collections.abc import Iterable, Iterator

import bpy

from ..rig.references import (
    DependencyGraph,
    Node,
    add_bones,
    add_drivers,
    bones_of_modifier,
    deforming_bones,
    is_armature,
    references,
)
from ..rig.sources import Sources
from ..scene.compatibility import accepts_slot, curves_of_slot, node_input_settings
from ..scene.node_groups import read_bone_names
from ..scene.scene_rig import SceneRig
from ..scene.temporary_state import animated_paths

_INVISIBLE_TYPES = {"ARMATURE", "LATTICE", "SPEAKER", "LIGHT_PROBE"}
"""Types of objects that no render shows."""
_CAGE_DISPLAY_TYPES = {"BOUNDS", "WIRE"}
_COLLIDING_MODIFIERS = {"CLOTH", "SOFT_BODY", "PARTICLE_SYSTEM"}
"""Modifiers that collide with all Collision objects, and that all force fields move."""
_SURFACE_MODIFIERS = {"NODES", "SCREW", "MESH_SEQUENCE_CACHE"}
"""Modifiers that can give a curve a surface."""
_UNFOLLOWED_TYPES = (bpy.types.Scene, bpy.types.WindowManager, bpy.types.Screen, bpy.types.WorkSpace)
"""Datablocks that use all objects, and need none of them except through drivers."""


def read_graph(
    scene_rigs: list[SceneRig], replaced_modifiers: dict[str, set[str]], straight: frozenset[str] = frozenset()
) -> DependencyGraph:
    """Read the dependency graph of the open file.

    Args:
        scene_rigs: the rigs whose meshes models deform; they share one armature object.
        replaced_modifiers: names of the modifiers that a model replaces, by name of the mesh object.
        straight: names of the bones whose B-Bone segments are removed, as from `unread_curves`.
    """
    graph = DependencyGraph()
    armature_object = scene_rigs[0].armature_object
    mesh_objects = {rig.mesh_object for rig in scene_rigs}
    armatures, none = {armature_object, armature_object.data}, frozenset()
    shape_keys = {mesh_object.data.shape_keys for mesh_object in mesh_objects} - {None}
    for datablock, used in used_datablocks().items():
        node = Node(datablock)
        if isinstance(datablock, _UNFOLLOWED_TYPES):
            add_drivers(graph, datablock)
            continue
        if datablock in mesh_objects:
            replaced = replaced_modifiers[datablock.name]
            modifiers = [m for m in datablock.modifiers if m.name not in replaced]
            replaced_needs = {n for name in replaced for n in _modifier_needs(datablock, datablock.modifiers[name])}
            graph.add(node, *(set(map(Node, used)) - replaced_needs))
            graph.add(node, *_object_needs(datablock, modifiers))
            add_drivers(graph, datablock, tuple(datablock.modifiers[name].path_from_id() for name in replaced))
            continue
        # The model replaces the shape keys, so only those that it reads need their drivers.
        optional_paths = ("key_blocks[", "eval_time") if datablock in shape_keys else ()
        add_drivers(graph, datablock, optional_paths, straight if datablock in armatures else none)
        if datablock in shape_keys:
            continue
        if isinstance(datablock, bpy.types.Object):
            graph.add(node, *_object_needs(datablock, datablock.modifiers))
        elif any(map(is_armature, used)):
            graph.add(node, *references(datablock))
        if is_armature(datablock):
            # Any of these slots may be assigned later.
            slots = [(a, slot) for a in bpy.data.actions for slot in a.slots if accepts_slot(datablock, slot)]
            keyed = {curve.data_path for action, slot in slots for curve in curves_of_slot(action, slot)}
            animated = keyed | animated_paths(datablock)
            add_bones(graph, datablock, animated, straight if datablock == armature_object else none)
            if datablock != armature_object:
                graph.add(node, *(Node(datablock, bone.name) for bone in datablock.data.bones))
        else:
            graph.add(node, *map(Node, used))
    return graph


def shown_objects(scene_rigs: list[SceneRig]) -> list[bpy.types.Object]:
    """Return the objects that a fast rig shows besides the meshes of its models.

    These are the objects of the scene that renders show in some frame, except cages that only the replaced deformation
    reads, and the objects of other scenes.
    """
    cages = {
        scene_object
        for scene_rig in scene_rigs
        for scene_object in Sources(scene_rig, scene_rig.mesh_object).objects
        if scene_object.type in {"LATTICE", "EMPTY"}
        or (scene_object.type == "CURVE" and not _has_surface(scene_object))
        or scene_object.display_type in _CAGE_DISPLAY_TYPES
    }
    scene = bpy.context.scene
    rendered = {o for layer in scene.view_layers for o in _rendered_objects(layer.layer_collection)}
    candidates = [o for o in bpy.data.objects if o in rendered or (o.name not in scene.objects and o.users_scene)]
    shown = [o for o in candidates if o not in cages and o.type not in _INVISIBLE_TYPES]
    return [o for o in shown if not o.hide_render or "hide_render" in animated_paths(o) or _is_shown_by_action(o)]


def _is_shown_by_action(scene_object: bpy.types.Object) -> bool:
    """Return whether an action that is not assigned may show an object: its slot has the name of this or of none."""
    slots = [(a, slot) for a in bpy.data.actions for slot in a.slots if accepts_slot(scene_object, slot)]
    return any(
        curve.data_path == "hide_render"
        for action, slot in slots
        if slot.name_display == scene_object.name or slot.name_display not in bpy.data.objects
        for curve in curves_of_slot(action, slot)
    )


def _has_surface(curve_object: bpy.types.Object) -> bool:
    """Return whether renders may show a curve: it is filled, or bevel, extrusion or a modifier gives it a surface."""
    curve = curve_object.data
    is_filled = curve.dimensions == "2D" and curve.fill_mode != "NONE" and any(s.use_cyclic_u for s in curve.splines)
    is_modified = any(modifier.type in _SURFACE_MODIFIERS for modifier in curve_object.modifiers)
    return is_filled or is_modified or bool(curve.bevel_depth or curve.extrude or curve.bevel_object)


def used_datablocks() -> dict[bpy.types.ID, set[bpy.types.ID]]:
    """Return the datablocks that each datablock of the file uses."""
    used: dict[bpy.types.ID, set[bpy.types.ID]] = {}
    for datablock, users in bpy.data.user_map().items():
        used.setdefault(datablock, set())
        for user in users:
            used.setdefault(user, set()).add(datablock)
    return used


def _object_needs(scene_object: bpy.types.Object, modifiers: Iterable[bpy.types.Modifier]) -> Iterator[Node]:
    """Yield what an object needs, with the given modifiers; not its bones and drivers."""
    yield from references(scene_object, "pose", "modifiers")
    if is_armature(scene_object.parent) and scene_object.parent_type == "ARMATURE":
        yield from deforming_bones(scene_object, scene_object.parent)
    if scene_object.rigid_body is not None:
        # All rigid bodies may collide, and constraints connect them.
        yield from (Node(o) for o in bpy.data.objects if o.rigid_body or o.rigid_body_constraint)
    for modifier in modifiers:
        yield from _modifier_needs(scene_object, modifier)


def _modifier_needs(scene_object: bpy.types.Object, modifier: bpy.types.Modifier) -> Iterator[Node]:
    """Yield the datablocks and bones that a modifier reads, except through drivers."""
    yield from references(modifier)
    yield from bones_of_modifier(scene_object, modifier)
    if modifier.type in _COLLIDING_MODIFIERS:
        yield from (Node(o) for o in bpy.data.objects if _moves_simulations(o))
    if modifier.type == "NODES" and modifier.node_group is not None:
        yield from (
            Node(value) for _, value in node_input_settings(modifier).values() if isinstance(value, bpy.types.ID)
        )
        if bone_names := set(read_bone_names(modifier.node_group)):
            bones = ((o, bone.name) for o in bpy.data.objects if is_armature(o) for bone in o.data.bones)
            yield from (Node(o, name) for o, name in bones if "" in bone_names or name in bone_names)


def _moves_simulations(scene_object: bpy.types.Object) -> bool:
    """Return whether simulated objects collide with an object, or a force field of it moves them."""
    has_field = scene_object.field is not None and scene_object.field.type != "NONE"
    return has_field or any(modifier.type == "COLLISION" for modifier in scene_object.modifiers)


def _rendered_objects(layer_collection: bpy.types.LayerCollection) -> Iterator[bpy.types.Object]:
    """Yield the objects of the collections that renders show."""
    if layer_collection.exclude or layer_collection.collection.hide_render:
        return
    yield from layer_collection.collection.objects
    for child in layer_collection.children:
        yield from _rendered_objects(child)
