# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the rig that the user works on: the active mesh with its armature, or the active armature with its mesh."""

from collections.abc import Callable

import bpy

from ..core.errors import RigError
from .draw_cache import draw_cached
from .scene_rig import SceneRig, armature_of, find_rig, parenting_message, rigs_of_armature


def active_rig(context: bpy.types.Context, mesh_object_name: str = "") -> SceneRig:
    """Find the rig of a mesh object or of the active object, without evaluating anything.

    The active object is a mesh that an armature deforms, or its armature. If the armature deforms several meshes, the
    rig is that of the selected mesh. If not exactly one mesh is selected, it is that of the mesh chosen in the sidebar,
    then of the only bound mesh, then of the first mesh.

    Args:
        context: the context with the active object.
        mesh_object_name: name of the mesh object; empty for the active object.

    Raises:
        RigError: there is no rig.
    """
    if mesh_object_name:
        return find_rig(mesh_object_name)
    active_object = context.view_layer.objects.active
    if active_object is None or active_object.type not in {"MESH", "ARMATURE"}:
        raise RigError("Nothing with a rig is active; select the mesh of a character, or its armature.")
    if active_object.type == "MESH":
        armature_object = armature_of(active_object)
        if armature_object is None:
            raise RigError(
                parenting_message(active_object)
                or f"'{active_object.name}' has no Armature modifier with an armature; add one, or select another mesh."
            )
        return SceneRig(active_object, armature_object)
    return SceneRig(_choose_mesh(context, active_object), active_object)


def cached_active_rig(context: bpy.types.Context) -> SceneRig | None:
    """Find the active rig, cached for drawing; return None if there is none."""
    return _cached_rigs(context, context.view_layer.objects.active, context.scene)[0]


def cached_rigs_together(context: bpy.types.Context) -> tuple[SceneRig, ...]:
    """Find the rigs of `rigs_together`, cached for drawing."""
    return _cached_rigs(context, context.view_layer.objects.active, context.scene)[1]


@draw_cached
def _cached_rigs(
    context: bpy.types.Context, active_object: bpy.types.Object | None, _scene: bpy.types.Scene
) -> tuple[SceneRig | None, tuple[SceneRig, ...]]:
    """Return the active rig, and the rigs of `rigs_together`."""
    try:
        return active_rig(context), tuple(rigs_together(context))
    except RigError:
        return None, ()


def any_mesh_object(context: bpy.types.Context, predicate: Callable[[bpy.types.Object], object]) -> bool:
    """Return whether a predicate holds for any mesh object of the scene, cached for drawing.

    Args:
        context: the context with the scene.
        predicate: a function at module level, because a lambda would be a new cache key in each call.
    """
    return _any_mesh_object(context.scene, predicate) is True


@draw_cached
def _any_mesh_object(scene: bpy.types.Scene, predicate: Callable[[bpy.types.Object], object]) -> bool | None:
    return any(o.type == "MESH" and predicate(o) for o in scene.objects) or None


def rigs_together(context: bpy.types.Context) -> list[SceneRig]:
    """Find the rigs of the checked meshes of the active character, if the active rig is one of several; else none."""
    try:
        rig = active_rig(context)
    except RigError:
        return []
    rigs = [each for each in rigs_of_armature(rig.armature_object) if each.mesh_object.fdda.in_model]
    return rigs if len(rigs) > 1 and rig in rigs else []


def _choose_mesh(context: bpy.types.Context, armature_object: bpy.types.Object) -> bpy.types.Object:
    meshes = [rig.mesh_object for rig in rigs_of_armature(armature_object)]
    if not meshes:
        for child in armature_object.children:
            if child.type == "MESH" and (message := parenting_message(child)):
                raise RigError(message)
        raise RigError(f"No mesh follows the armature '{armature_object.name}'; give one an Armature modifier.")
    chosen_name = context.window_manager.fdda.mesh
    predicates = (lambda o: o.select_get(), lambda o: o.name == chosen_name, lambda o: o.fdda.is_bound)
    for matches in ([o for o in meshes if predicate(o)] for predicate in predicates):
        if len(matches) == 1:
            return matches[0]
    return meshes[0]
