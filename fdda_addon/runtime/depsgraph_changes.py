# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads from a dependency graph which parts of rigs an evaluation has changed.

Blender does not document these rules; they were observed on 4.5 and 5.2. Edited data are also reported as transformed
(`is_updated_transform`), although data have no transform. A mesh is not reported as transformed if its shape keys are
driven, or if only positions were written. Posing reports the armature data as transformed; the armature object is
reported only if it was edited or moved.
"""

from dataclasses import dataclass

import bpy
from bpy.types import Armature, Key, Mesh, Object


@dataclass(frozen=True)
class DepsgraphChanges:
    """Parts of rigs that an evaluation has changed.

    Attributes:
        mesh_objects: the changed mesh objects, and whether their geometry changed.
        armatures: session ids of the armatures that were posed or edited.
        meshes: by the session id of each changed mesh: whether more than its rest positions may have changed.
    """

    mesh_objects: list[tuple[bpy.types.Object, bool]]
    armatures: set[int]
    meshes: dict[int, bool]

    @staticmethod
    def read(depsgraph: bpy.types.Depsgraph) -> "DepsgraphChanges":
        """Read the changes of the evaluation that has just ended."""
        changes = DepsgraphChanges([], set(), changed_meshes(depsgraph))
        for update in depsgraph.updates:
            datablock = update.id
            if isinstance(datablock, Object):
                original_object = datablock.original
                if original_object.type == "MESH":
                    changes.mesh_objects.append((original_object, update.is_updated_geometry))
                elif original_object.type == "ARMATURE" and update.is_updated_geometry and update.is_updated_transform:
                    changes.armatures.add(original_object.data.session_uid)
            elif isinstance(datablock, Armature) and _is_edited(update):
                changes.armatures.add(datablock.original.session_uid)
        return changes


def has_edited_armature(depsgraph: bpy.types.Depsgraph) -> bool:
    """Return whether armature data have changed by more than their drivers and keys."""
    return any(_is_edited(update) for update in depsgraph.updates if isinstance(update.id, Armature))


def _is_edited(update: bpy.types.DepsgraphUpdate) -> bool:
    """Return whether armature data were posed or edited.

    Rigs of Rigify drive the B-Bones, so that Blender reports their armature data in every frame, neither as transformed
    nor with changed geometry. Edits and poses set by hand are reported with both.
    """
    return update.is_updated_geometry or update.is_updated_transform or update.id.original.animation_data is None


def changed_meshes(depsgraph: bpy.types.Depsgraph) -> dict[int, bool]:
    """Read only `DepsgraphChanges.meshes`: in most frames there are none, and nothing else has to be read."""
    meshes: dict[int, bool] = {}
    driven_keys, edited_keys = [], []
    for update in depsgraph.updates:
        datablock = update.id
        if isinstance(datablock, Mesh):
            if update.is_updated_geometry or update.is_updated_transform:
                meshes[datablock.original.session_uid] = update.is_updated_transform
        elif isinstance(datablock, Key) and update.is_updated_geometry:
            if update.is_updated_transform:
                edited_keys.append(datablock)
            else:
                driven_keys.append(datablock)
    for shape_keys in driven_keys:
        mesh_uid = shape_keys.original.user.session_uid
        if meshes.get(mesh_uid) is False:
            del meshes[mesh_uid]
    for shape_keys in edited_keys:
        # Blender does not report the mesh when only a driver or an action of its shape keys has changed.
        meshes[shape_keys.original.user.session_uid] = True
    return meshes
