# SPDX-License-Identifier: GPL-3.0-or-later
"""The rig that the user works on: the active mesh and its armature, or the other way round."""

import bpy

from ..core.errors import RigError
from .scene_rig import SceneRig, armature_of, find_rig, parenting_sentence


def active_rig(context: bpy.types.Context, name: str = "") -> SceneRig:
    """The rig of a mesh object, or of the active object: a mesh that an armature deforms, or its armature.

    Of several meshes that follow the active armature, the one that is selected is meant, or the one that has a model.
    Nothing is evaluated: this is cheap enough to draw with.

    Args:
        context: where the active object is.
        name: of the mesh object, empty for the active object.

    Raises:
        RigError: there is none, or it is not clear which is meant.
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
                parenting_sentence(active)
                or f"'{active.name}' has no Armature modifier with an armature; add one, or select another mesh."
            )
        return SceneRig(active, armature_object)
    return SceneRig(_mesh_of(context, active), active)


def _mesh_of(context: bpy.types.Context, armature_object: bpy.types.Object) -> bpy.types.Object:
    meshes = [o for o in context.scene.objects if o.type == "MESH" and _follows(o, armature_object)]
    if not meshes:
        for child in armature_object.children:
            if child.type == "MESH" and (sentence := parenting_sentence(child)):
                raise RigError(sentence)
        raise RigError(f"No mesh follows the armature '{armature_object.name}'; give one an Armature modifier.")
    for chosen in (meshes, [o for o in meshes if o.select_get()], [o for o in meshes if o.fdda.is_bound]):
        if len(chosen) == 1:
            return chosen[0]
    names = ", ".join(f"'{o.name}'" for o in meshes[:3]) + (", …" if len(meshes) > 3 else "")
    raise RigError(f"{len(meshes)} meshes follow '{armature_object.name}' ({names}); select the one that is meant.")


def _follows(mesh_object: bpy.types.Object, armature_object: bpy.types.Object) -> bool:
    return armature_of(mesh_object) == armature_object
