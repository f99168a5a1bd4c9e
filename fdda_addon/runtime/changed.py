# SPDX-License-Identifier: GPL-3.0-or-later
"""What an evaluation has changed of the datablocks that rigs consist of, as Blender reports it.

Found by trying, on 4.5 and 5.2. Data that were changed themselves are reported as moved too (`is_updated_transform`),
which data cannot be; a mesh whose shape keys are driven is not, nor one of which only positions were written. An
armature's data are always reported so when it is posed; its object is only when it was edited or moved.
"""

from dataclasses import dataclass

import bpy


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
        changed = Changed([], {}, {})
        driven_keys: set[bpy.types.ID] = set()
        # With the relations of the scene; on 4.5 that is all that says that a vertex group has gone.
        any_relation = depsgraph.id_type_updated("SCENE")
        for update in depsgraph.updates:
            found, is_shape, is_moved = update.id.original, update.is_updated_geometry, update.is_updated_transform
            if isinstance(found, bpy.types.Object):
                if found.type == "MESH":
                    changed.mesh_objects.append((found, is_shape, any_relation or is_moved or not is_shape))
                elif found.type == "ARMATURE" and is_shape and is_moved:
                    changed.armatures[found.data.session_uid] = True
            elif isinstance(found, bpy.types.Armature):
                is_posed = is_shape and is_moved
                changed.armatures[found.session_uid] = changed.armatures.get(found.session_uid, False) or not is_posed
            elif isinstance(found, bpy.types.Mesh) and (is_shape or is_moved):
                changed.meshes[found.session_uid] = is_moved
            elif isinstance(found, bpy.types.Key) and is_shape and not is_moved:
                driven_keys.add(found.user)
        for mesh in driven_keys:
            if changed.meshes.get(mesh.session_uid) is False:
                del changed.meshes[mesh.session_uid]
        return changed
