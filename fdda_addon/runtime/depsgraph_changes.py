# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads from a dependency graph which parts of rigs an evaluation has changed.

Blender does not document these rules; they were observed on 4.5 and 5.2. Edited data are also reported as transformed
(`is_updated_transform`), although data have no transform. A mesh is not reported as transformed if its shape keys are
driven, or if only positions were written. Posing reports the armature data as transformed; the armature object is
reported only if it was edited or moved.

Posing by hand copies the armature data, but not the mesh object; an edited datablock is always copied. So a mark on the
evaluated copy tells whether Blender has copied the datablock since the last report.
"""

from dataclasses import dataclass

import bpy
from bpy.types import Armature, Key, Mesh, Object

_SEEN_KEY = "fdda_seen"
"""Custom property of evaluated objects and armatures whose changes were read: the mode of their graph, and the
session id of the original. Blender removes it with the evaluated copy."""


@dataclass(frozen=True)
class DepsgraphChanges:
    """Parts of rigs that an evaluation has changed.

    Attributes:
        mesh_objects: the changed bound objects, and whether more than their pose may have changed.
        armatures: by the session id of each armature that was posed or edited: whether it may have been edited.
        meshes: by the session id of each changed mesh: whether more than its rest positions may have changed.
    """

    mesh_objects: list[tuple[bpy.types.Object, bool]]
    armatures: dict[int, bool]
    meshes: dict[int, bool]

    @staticmethod
    def read(depsgraph: bpy.types.Depsgraph) -> "DepsgraphChanges":
        """Read the changes of the evaluation that has just ended."""
        changes = DepsgraphChanges([], {}, changed_meshes(depsgraph))
        for update in depsgraph.updates:
            datablock = update.id
            if isinstance(datablock, Object):
                if datablock.type == "MESH" and datablock.fdda.is_bound:
                    # Changed vertex groups may only change relations, which Blender reports as shading.
                    is_edited = not seen_mode(datablock) or update.is_updated_shading
                    changes.mesh_objects.append((datablock.original, is_edited))
                    _mark_seen(datablock, depsgraph.mode)
                elif datablock.type == "ARMATURE" and update.is_updated_geometry and update.is_updated_transform:
                    changes.armatures[datablock.data.original.session_uid] = True
            elif isinstance(datablock, Armature) and not seen_mode(datablock):
                is_posed = update.is_updated_geometry and update.is_updated_transform
                changes.armatures.setdefault(datablock.original.session_uid, not is_posed)
                _mark_seen(datablock, depsgraph.mode)
        return changes


def seen_mode(datablock: bpy.types.ID) -> str:
    """Return the mode of the graph whose changes of an evaluated datablock were read, "VIEWPORT" or "RENDER".

    It is empty if Blender has copied the datablock since.
    """
    mode, _, uid = datablock.get(_SEEN_KEY, "").partition(" ")
    # Scripts that copy an evaluated datablock into the file copy the mark of another datablock.
    return mode if uid == str(datablock.original.session_uid) else ""


def _mark_seen(datablock: bpy.types.ID, mode: str) -> None:
    datablock[_SEEN_KEY] = f"{mode} {datablock.original.session_uid}"


def has_copied_armature(depsgraph: bpy.types.Depsgraph) -> bool:
    """Return whether armature data have changed by more than their drivers and keys.

    Rigs of Rigify drive the B-Bones, so that Blender reports their armature data in every frame.
    """
    return any(isinstance(update.id, Armature) and not seen_mode(update.id) for update in depsgraph.updates)


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
