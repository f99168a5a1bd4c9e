# SPDX-License-Identifier: GPL-3.0-or-later
"""The rig that the user works on: the active mesh and its armature, or the other way round."""

from collections.abc import Callable

import bpy

from ..core.errors import RigError
from .comparison import is_comparison
from .draw_cache import draw_cached
from .scene_rig import SceneRig, armature_of, find_rig, parenting_message


def active_rig(context: bpy.types.Context, name: str = "") -> SceneRig:
    """The rig of a mesh object, or of the active object: a mesh that an armature deforms, or its armature.

    Of several meshes that follow the active armature, the one that is selected is meant, else the one that was chosen
    in the sidebar, else the one that has a model, else the first. Nothing is evaluated.

    Args:
        context: where the active object is.
        name: of the mesh object, empty for the active object.

    Raises:
        RigError: there is none.
    """
    if name:
        return find_rig(name)
    active = context.view_layer.objects.active
    if active is None or active.type not in {"MESH", "ARMATURE"}:
        raise RigError("Nothing with a rig is active; select the mesh of a character, or its armature.")
    if active.type == "MESH":
        armature_object = armature_of(active)
        if armature_object is None:
            raise RigError(
                parenting_message(active)
                or f"'{active.name}' has no Armature modifier with an armature; add one, or select another mesh."
            )
        return SceneRig(active, armature_object)
    return SceneRig(_mesh_of(context, active), active)


def cached_active_rig(context: bpy.types.Context) -> SceneRig | None:
    """As `active_rig` for what is drawn again and again: None where there is none."""
    active = context.view_layer.objects.active
    return None if active is None else _shown_rig(context, active, context.scene)


@draw_cached
def _shown_rig(context: bpy.types.Context, _active: bpy.types.Object, _scene: bpy.types.Scene) -> SceneRig | None:
    try:
        return active_rig(context)
    except RigError:
        return None


def cached_rigs_of_active_armature(context: bpy.types.Context) -> tuple[SceneRig, ...]:
    """As `rigs_of_active_armature` for what is drawn again and again."""
    return _shown_together(context, context.view_layer.objects.active, context.scene)


@draw_cached
def _shown_together(
    context: bpy.types.Context, _active: bpy.types.Object, _scene: bpy.types.Scene
) -> tuple[SceneRig, ...]:
    return tuple(rigs_of_active_armature(context))


def any_mesh_object(context: bpy.types.Context, fact: Callable[[bpy.types.Object], object]) -> bool:
    """Whether something is true of a mesh object of the scene; for polls, with a function that is defined once."""
    return _any_mesh(context.scene, fact) is True


@draw_cached
def _any_mesh(scene: bpy.types.Scene, fact: Callable[[bpy.types.Object], object]) -> bool | None:
    return any(o.type == "MESH" and fact(o) for o in scene.objects) or None


def rigs_of_active_armature(context: bpy.types.Context) -> list[SceneRig]:
    """The rigs of all meshes that follow the active armature, where it is active and there are several; else none."""
    active = context.view_layer.objects.active
    if active is None or active.type != "ARMATURE":
        return []
    meshes = _meshes_of(context, active)
    return [SceneRig(mesh_object, active) for mesh_object in meshes] if len(meshes) > 1 else []


def _meshes_of(context: bpy.types.Context, armature_object: bpy.types.Object) -> list[bpy.types.Object]:
    meshes = [o for o in context.scene.objects if o.type == "MESH" and _follows(o, armature_object)]
    return [o for o in meshes if not is_comparison(o)]


def _mesh_of(context: bpy.types.Context, armature_object: bpy.types.Object) -> bpy.types.Object:
    meshes = _meshes_of(context, armature_object)
    if not meshes:
        for child in armature_object.children:
            if child.type == "MESH" and (sentence := parenting_message(child)):
                raise RigError(sentence)
        raise RigError(f"No mesh follows the armature '{armature_object.name}'; give one an Armature modifier.")
    name = context.window_manager.fdda.mesh
    ways = (lambda o: o.select_get(), lambda o: o.name == name, lambda o: o.fdda.is_bound)
    for found in ([o for o in meshes if way(o)] for way in ways):
        if len(found) == 1:
            return found[0]
    return meshes[0]


def _follows(mesh_object: bpy.types.Object, armature_object: bpy.types.Object) -> bool:
    return armature_of(mesh_object) == armature_object
