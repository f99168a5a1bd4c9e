# SPDX-License-Identifier: GPL-3.0-or-later
"""Spares the first of the two evaluations of a mesh that a new frame costs.

Blender evaluates a frame, hands the pose to the playback, and evaluates once more what the playback has written. In the
first round the modifier that plays the model could only show the last frame's positions: it rests, in the evaluated
copy of the object alone. Nothing of the user's scene is changed, and the copy is made anew from it in any doubt.

Simulations take a step in the first round and need the mesh where it was last: with one in the file nothing rests.
"""

from collections.abc import Iterable, Iterator

import bpy

from . import nodes

SIMULATING = {"CLOTH", "DYNAMIC_PAINT", "EXPLODE", "FLUID", "PARTICLE_SYSTEM", "SOFT_BODY"}

_resting: set[int] = set()
_simulates: bool | None = None


def forget() -> None:
    """Look for simulations anew before the next frame."""
    global _simulates
    _simulates = None


def rest(scene: bpy.types.Scene, mesh_objects: Iterable[bpy.types.Object]) -> None:
    """Let the models of bound objects rest until `wake`; for `frame_change_pre`.

    An object on which other modifiers work does not rest: they would be evaluated on a mesh that is not deformed.
    """
    global _simulates
    if _simulates is None:
        _simulates = _has_simulation(scene)
    if _simulates:
        return
    for mesh_object in mesh_objects:
        for modifier in _evaluated_modifiers(scene, mesh_object):
            modifier.show_viewport = False
            _resting.add(mesh_object.session_uid)


def wake(scene: bpy.types.Scene, mesh_objects: Iterable[bpy.types.Object]) -> set[bpy.types.Object]:
    """Let the models of bound objects play again in the next round; gives those that rested."""
    rested = {mesh_object for mesh_object in mesh_objects if mesh_object.session_uid in _resting} if _resting else set()
    _resting.clear()
    for mesh_object in rested:
        for depsgraph in _graphs(scene):
            evaluated = mesh_object.evaluated_get(depsgraph)
            modifier = nodes.find_modifier(evaluated) if evaluated.is_evaluated else None
            if modifier is not None:
                modifier.show_viewport = True
    return rested


def updated(depsgraph: bpy.types.Depsgraph, rested: set[bpy.types.Object]) -> set[bpy.types.Object]:
    """Those of the objects that rested whose meshes were evaluated meanwhile, and have to be once more."""
    if not rested:
        return rested
    return {update.id.original for update in depsgraph.updates if update.is_updated_geometry} & rested


def _graphs(scene: bpy.types.Scene) -> Iterator[bpy.types.Depsgraph]:
    return (layer.depsgraph for layer in scene.view_layers if layer.depsgraph is not None)


def _evaluated_modifiers(scene: bpy.types.Scene, mesh_object: bpy.types.Object) -> Iterator[bpy.types.Modifier]:
    """The modifier that plays, in each evaluated copy of an object in which it alone is on."""
    for depsgraph in _graphs(scene):
        evaluated = mesh_object.evaluated_get(depsgraph)
        if evaluated.is_evaluated:
            shown = [modifier for modifier in evaluated.modifiers if modifier.show_viewport]
            if len(shown) == 1 and nodes.find_modifier(evaluated) == shown[0]:
                yield shown[0]


def _has_simulation(scene: bpy.types.Scene) -> bool:
    if scene.rigidbody_world is not None:
        return True
    if any(node.bl_idname == "GeometryNodeSimulationInput" for group in bpy.data.node_groups for node in group.nodes):
        return True
    return any(modifier.type in SIMULATING for o in scene.objects for modifier in o.modifiers)
