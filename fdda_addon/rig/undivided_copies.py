# SPDX-License-Identifier: GPL-3.0-or-later
"""Temporary copies of meshes without downstream modifiers, where other meshes read the meshes with these modifiers.

An example is a body that a modifier subdivides, and a shirt with a Surface Deform modifier on it.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import bpy

from ..core.controls import Control
from ..core.errors import RigError
from ..scene.comparison import COMPARISON_KEY
from ..scene.controls import owner_of
from ..scene.scene_rig import SceneRig
from .dependencies import deforming_mesh_objects
from .modifier_stack import read_stack


def find_read_meshes(scene_rig: SceneRig, controls: Iterable[Control]) -> list[bpy.types.Object]:
    """Find the meshes of a rig that have downstream modifiers and deform other meshes of it.

    Raises:
        RigError: a control is a property of such a mesh, which a copy would not have.
    """
    meshes = scene_rig.mesh_objects
    if len(meshes) == 1:
        return []
    read = {read_object for mesh_object in meshes for read_object in deforming_mesh_objects(scene_rig, mesh_object)}
    read_meshes = [mesh_object for mesh_object in meshes if mesh_object in read and read_stack(mesh_object).downstream]
    for control in controls:
        if (owner := owner_of(scene_rig, control.owner)) in read_meshes:
            raise RigError(
                f"Another mesh follows the surface of '{owner.name}' with its modifier "
                f"'{read_stack(owner).downstream[0]}', and '{control.name}' is an input: the two are not recorded "
                "together; switch the modifier off in the viewport, or record each mesh by itself."
            )
    return read_meshes


@contextmanager
def undivided_copies(mesh_objects: Iterable[bpy.types.Object]) -> Iterator[dict[bpy.types.Object, bpy.types.Object]]:
    """Copy mesh objects without their downstream modifiers, and remove the copies afterwards.

    The copies have the meshes and shape keys of the objects.

    Yields:
        The copies by mesh object.
    """
    copies = {}
    try:
        for mesh_object in mesh_objects:
            downstream = read_stack(mesh_object).downstream
            # Make the copy local, because modifiers of a library override cannot be removed.
            copies[mesh_object] = copied = mesh_object.copy().make_local()
            copied.is_runtime_data = True
            copied[COMPARISON_KEY] = mesh_object
            for name in downstream:
                copied.modifiers.remove(copied.modifiers[name])
            bpy.context.scene.collection.objects.link(copied)
        if copies:
            bpy.context.view_layer.update()
        yield copies
    finally:
        for copied in copies.values():
            bpy.data.objects.remove(copied)
