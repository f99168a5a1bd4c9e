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
        mesh_objects: for each changed mesh object: the object, whether its geometry changed, and whether anything
            besides its pose may have changed.
        armatures: by the session id of each changed armature: whether the parents of its bones may have changed too.
        meshes: by the session id of each changed mesh: whether more than its rest positions may have changed.
    """

    mesh_objects: list[tuple[bpy.types.Object, bool, bool]]
    armatures: dict[int, bool]
    meshes: dict[int, bool]

    @staticmethod
    def read(depsgraph: bpy.types.Depsgraph) -> "DepsgraphChanges":
        """Read the changes of the evaluation that has just ended."""
        changes = DepsgraphChanges([], {}, changed_meshes(depsgraph))
        # On Blender 4.5 only changed relations of the scene report that a vertex group was removed.
        relations_changed = depsgraph.id_type_updated("SCENE")
        for update in depsgraph.updates:
            datablock = update.id
            geometry_changed, transform_changed = update.is_updated_geometry, update.is_updated_transform
            if isinstance(datablock, Object):
                original_object = datablock.original
                if original_object.type == "MESH":
                    changed_beyond_pose = relations_changed or transform_changed or not geometry_changed
                    changes.mesh_objects.append((original_object, geometry_changed, changed_beyond_pose))
                elif original_object.type == "ARMATURE" and geometry_changed and transform_changed:
                    changes.armatures[original_object.data.session_uid] = True
            elif isinstance(datablock, Armature):
                armature_uid, is_only_posed = datablock.original.session_uid, geometry_changed and transform_changed
                changes.armatures[armature_uid] = changes.armatures.get(armature_uid, False) or not is_only_posed
        return changes


def has_edited_armature(depsgraph: bpy.types.Depsgraph) -> bool:
    """Return whether armature data have changed by more than their drivers and keys.

    Rigs of Rigify drive the B-Bones, so that Blender reports their armature data in every frame, neither as transformed
    nor with changed geometry. Edits are reported with both.
    """
    return any(
        update.is_updated_geometry or update.is_updated_transform or update.id.original.animation_data is None
        for update in depsgraph.updates
        if isinstance(update.id, Armature)
    )


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
