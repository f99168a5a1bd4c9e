# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the rig in a scene, or says why there is none. Nothing here is evaluated and numpy is not needed."""

from dataclasses import dataclass

import bpy

from ..core.errors import RigError

MODIFIER_NAME = "FDDA"
"""Name of the Geometry Nodes modifier that plays a model; it is never part of the rig."""


@dataclass(frozen=True)
class SceneRig:
    """A mesh object and the armature object that deforms it. Holds RNA references: not to be kept."""

    mesh_object: bpy.types.Object
    armature_object: bpy.types.Object


def find_rig(name: str = "") -> SceneRig:
    """Find the rig of the current scene.

    Args:
        name: of the mesh object; may be left out when one mesh of the scene has an Armature modifier.

    Raises:
        RigError: there is none, or more than one.
    """
    meshes = [o for o in bpy.context.scene.objects if o.type == "MESH"]
    if name:
        named = bpy.context.scene.objects.get(name)
        if named is None or named.type != "MESH":
            known = ", ".join(f"'{o.name}'" for o in meshes) or "none"
            raise RigError(f"The scene has no mesh object '{name}'; its mesh objects: {known}.")
        meshes = [named]
    if not meshes:
        raise RigError("The scene has no mesh; open a file with a character that an armature deforms.")
    rigged = [o for o in meshes if armature_modifier(o) is not None]
    if not rigged:
        what = f"'{name}' has no" if name else f"None of the {len(meshes)} meshes of the scene has an"
        raise RigError(f"{what} Armature modifier with an armature; add one, or choose another object.")
    if len(rigged) > 1:
        names = ", ".join(f"'{o.name}'" for o in rigged)
        raise RigError(f"{len(rigged)} meshes have an Armature modifier ({names}); choose one with --object.")
    return SceneRig(rigged[0], armature_modifier(rigged[0]).object)


def armature_modifier(mesh_object: bpy.types.Object) -> bpy.types.ArmatureModifier | None:
    """The first Armature modifier that has an armature, None when there is none."""
    for modifier in mesh_object.modifiers:
        if modifier.type == "ARMATURE" and modifier.object is not None:
            return modifier
    return None
