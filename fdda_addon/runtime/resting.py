# SPDX-License-Identifier: GPL-3.0-or-later
"""Spares the first of the two evaluations of a mesh that a new frame costs.

Blender evaluates a frame, hands the pose to the playback, and evaluates once more what the playback has written. In the
first round the modifier that plays the model could only show the last frame's positions: it rests, in the evaluated
copy of the object alone. Nothing of the user's scene is changed, and the copy is made anew from it in any doubt.

Simulations take a step in the first round and need the mesh where it was last: with one in the file nothing rests.
"""

from collections.abc import Iterable

import bpy

from . import nodes

SIMULATING = {"CLOTH", "DYNAMIC_PAINT", "EXPLODE", "FLUID", "PARTICLE_SYSTEM", "SOFT_BODY"}

_resting: dict[int, str] = {}
"""Name of the modifier that rests, by session id of the object."""
_simulates: dict[int, bool] = {}
"""Whether a scene has a simulation, by its session id."""


def forget() -> None:
    """Look for simulations anew before the next frame."""
    _simulates.clear()


def rest(scene: bpy.types.Scene, mesh_objects: Iterable[bpy.types.Object]) -> None:
    """Let the models of bound objects rest until `wake`; for `frame_change_pre`.

    An object on which other modifiers work does not rest: they would be evaluated on a mesh that is not deformed.
    """
    if scene.session_uid not in _simulates:
        _simulates[scene.session_uid] = _has_simulation(scene)
    if _simulates[scene.session_uid]:
        return
    graphs = _graphs(scene)
    for mesh_object in mesh_objects:
        for depsgraph in graphs:
            modifier = _only_modifier(mesh_object.evaluated_get(depsgraph))
            if modifier is not None:
                modifier.show_viewport = False
                _resting[mesh_object.session_uid] = modifier.name


def wake(scene: bpy.types.Scene, mesh_objects: Iterable[bpy.types.Object]) -> set[bpy.types.Object]:
    """Let the models of bound objects play again in the next round; gives those that rested."""
    if not _resting:
        return set()
    graphs = _graphs(scene)
    rested = set()
    for mesh_object in mesh_objects:
        name = _resting.get(mesh_object.session_uid)
        if name is None:
            continue
        rested.add(mesh_object)
        for depsgraph in graphs:
            evaluated = mesh_object.evaluated_get(depsgraph)
            modifier = evaluated.modifiers.get(name) if evaluated.is_evaluated else None
            if modifier is not None:
                modifier.show_viewport = True
    _resting.clear()
    return rested


def is_updated(depsgraph: bpy.types.Depsgraph, mesh_object: bpy.types.Object) -> bool:
    """Whether the mesh of an object that rested was evaluated meanwhile, and has to be once more."""
    return any(update.is_updated_geometry and update.id.original == mesh_object for update in depsgraph.updates)


def _graphs(scene: bpy.types.Scene) -> list[bpy.types.Depsgraph]:
    return [graph for layer in scene.view_layers if (graph := layer.depsgraph) is not None]


def _only_modifier(evaluated: bpy.types.Object) -> bpy.types.Modifier | None:
    """The modifier that plays, of an evaluated object in which it alone is on."""
    if not evaluated.is_evaluated:
        return None
    shown = [modifier for modifier in evaluated.modifiers if modifier.show_viewport]
    return shown[0] if len(shown) == 1 and nodes.plays(shown[0]) else None


def _has_simulation(scene: bpy.types.Scene) -> bool:
    if scene.rigidbody_world is not None:
        return True
    if any(node.bl_idname == "GeometryNodeSimulationInput" for group in bpy.data.node_groups for node in group.nodes):
        return True
    return any(modifier.type in SIMULATING for o in scene.objects for modifier in o.modifiers)
