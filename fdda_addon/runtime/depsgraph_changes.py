# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads from a dependency graph which parts of rigs an evaluation has changed.

Blender does not document these rules; they were observed on 4.5 and 5.2. Edited data are also reported as transformed
(`is_updated_transform`), although data have no transform. A mesh whose shape keys are driven is not reported so, nor
one of which only positions were written. Posing reports an armature's data so in any case, and the armature object only
when it was edited or moved.
"""

from dataclasses import dataclass

import bpy
from bpy.types import Armature, Key, Mesh, Object


@dataclass(frozen=True)
class DepsgraphChanges:
    """Parts of rigs that an evaluation has changed.

    Attributes:
        mesh_objects: mesh objects; whether the geometry changed; whether anything besides the pose may have changed.
        armatures: session ids of armature data; whether the parents of bones may have changed too.
        meshes: session ids of meshes; whether more than the rest positions may have changed.
    """

    mesh_objects: list[tuple[bpy.types.Object, bool, bool]]
    armatures: dict[int, bool]
    meshes: dict[int, bool]

    @staticmethod
    def read(depsgraph: bpy.types.Depsgraph) -> "DepsgraphChanges":
        """Read the changes of an evaluation right after it."""
        changes = DepsgraphChanges([], {}, changed_meshes(depsgraph))
        # Changed relations of the scene: on 4.5 nothing else reports that a vertex group was removed.
        relations_changed = depsgraph.id_type_updated("SCENE")
        for update in depsgraph.updates:
            datablock, is_geometry, is_transform = update.id, update.is_updated_geometry, update.is_updated_transform
            if isinstance(datablock, Object):
                original = datablock.original
                if original.type == "MESH":
                    beyond_pose = relations_changed or is_transform or not is_geometry
                    changes.mesh_objects.append((original, is_geometry, beyond_pose))
                elif original.type == "ARMATURE" and is_geometry and is_transform:
                    changes.armatures[original.data.session_uid] = True
            elif isinstance(datablock, Armature):
                uid, is_posed = datablock.original.session_uid, is_geometry and is_transform
                changes.armatures[uid] = changes.armatures.get(uid, False) or not is_posed
        return changes


def changed_meshes(depsgraph: bpy.types.Depsgraph) -> dict[int, bool]:
    """Read `DepsgraphChanges.meshes` alone; in most frames they are empty and nothing else is needed."""
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
    for key in driven_keys:
        uid = key.original.user.session_uid
        if meshes.get(uid) is False:
            del meshes[uid]
    for key in edited_keys:
        # Blender does not report the mesh when only a driver or an action of its shape keys has changed.
        meshes[key.original.user.session_uid] = True
    return meshes
