# SPDX-License-Identifier: GPL-3.0-or-later
"""What an evaluation has changed of the datablocks that rigs consist of, as Blender reports it.

Found by trying, on 4.5 and 5.2. Data that were changed themselves are reported as moved too (`is_updated_transform`),
which data cannot be; a mesh whose shape keys are driven is not, nor one of which only positions were written. An
armature's data are always reported so when it is posed; its object is only when it was edited or moved.
"""

from dataclasses import dataclass

import bpy
from bpy.types import Armature, Key, Mesh, Object


@dataclass(frozen=True)
class Changed:
    """What an evaluation has changed.

    Attributes:
        mesh_objects: mesh objects; whether they have another shape now; whether more may have changed than a pose.
        armatures: session ids of armature data, and whether more may have changed than what is quickly read.
        meshes: session ids of meshes, and whether more may have changed than their rest positions.
    """

    mesh_objects: list[tuple[bpy.types.Object, bool, bool]]
    armatures: dict[int, bool]
    meshes: dict[int, bool]

    @staticmethod
    def by(depsgraph: bpy.types.Depsgraph) -> "Changed":
        """Read what an evaluation has changed, right after it."""
        changed = Changed([], {}, changed_meshes(depsgraph))
        # With the relations of the scene; on 4.5 that is all that says that a vertex group has gone.
        any_relation = depsgraph.id_type_updated("SCENE")
        for update in depsgraph.updates:
            found, is_shape, is_moved = update.id, update.is_updated_geometry, update.is_updated_transform
            if isinstance(found, Object):
                original = found.original
                if original.type == "MESH":
                    changed.mesh_objects.append((original, is_shape, any_relation or is_moved or not is_shape))
                elif original.type == "ARMATURE" and is_shape and is_moved:
                    changed.armatures[original.data.session_uid] = True
            elif isinstance(found, Armature):
                uid, is_posed = found.original.session_uid, is_shape and is_moved
                changed.armatures[uid] = changed.armatures.get(uid, False) or not is_posed
        return changed


def changed_meshes(depsgraph: bpy.types.Depsgraph) -> dict[int, bool]:
    """The `meshes` of `Changed` alone: in most frames there are none, and that is all that has to be known."""
    meshes: dict[int, bool] = {}
    driven_keys, edited_keys = [], []
    for update in depsgraph.updates:
        found = update.id
        if isinstance(found, Mesh):
            if update.is_updated_geometry or update.is_updated_transform:
                meshes[found.original.session_uid] = update.is_updated_transform
        elif isinstance(found, Key) and update.is_updated_geometry:
            if update.is_updated_transform:
                edited_keys.append(found)
            else:
                driven_keys.append(found)
    for key in driven_keys:
        uid = key.original.user.session_uid
        if meshes.get(uid) is False:
            del meshes[uid]
    for key in edited_keys:
        # Where only a driver or an action of theirs is another, the mesh does not say so.
        meshes[key.original.user.session_uid] = True
    return meshes
