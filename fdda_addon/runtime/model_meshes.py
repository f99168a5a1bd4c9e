# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the mesh objects of a file that the meshes of a model are."""

from collections.abc import Container
from contextlib import suppress
from pathlib import Path

import bpy

from ..core.errors import ModelError
from ..core.formats.model_info import ModelInfo
from ..core.rig import Fingerprint, MeshPart
from ..core.wording import format_with_noun
from ..scene.comparison import is_comparison
from ..scene.mesh import rest_positions, topology
from ..scene.scene_rig import SceneRig, armature_of, name_without_number


def find_mesh(path: Path, info: ModelInfo, mesh_object: bpy.types.Object) -> str:
    """Return the name of the mesh of a model that a mesh object is: by the stored name, its shape or its own name.

    Args:
        path, info: path and metadata of the model.

    Raises:
        ModelError: the model has no such mesh.
    """
    names = [mesh.name for mesh in info.meshes]
    if len(names) == 1:
        return names[0]
    if mesh_object.fdda.model_mesh in names:
        return mesh_object.fdda.model_mesh
    fitting_names = [mesh.name for mesh in info.meshes if has_shape(mesh_object, mesh)]
    own_names = mesh_object.name, name_without_number(mesh_object)
    for candidates in (fitting_names, names):
        for name in own_names:
            if name in candidates:
                return name
        if len(fitting_names) == 1:
            return fitting_names[0]
    quoted_names = ", ".join(f"'{name}'" for name in names)
    raise ModelError(
        f"The model '{path}' does not deform '{mesh_object.name}': it has the meshes {quoted_names}. Bind it to one of "
        "these, or record and train this mesh."
    )


def info_of_mesh(path: Path, info: ModelInfo, mesh_object: bpy.types.Object) -> ModelInfo:
    """Return the metadata of a model for one mesh object; arguments and errors as of `find_mesh`."""
    name = find_mesh(path, info, mesh_object)
    return info.of_mesh(next(mesh for mesh in info.meshes if mesh.name == name))


def has_shape(mesh_object: bpy.types.Object, mesh: MeshPart) -> bool:
    """Return whether a mesh object has the topology and the rest positions of a mesh of a recording or model."""
    data, fingerprint = mesh_object.data, mesh.fingerprint
    return (
        len(data.vertices) == mesh.vertices
        and Fingerprint.digest(*topology(data)) == fingerprint.topology
        and Fingerprint.digest(rest_positions(data)) == fingerprint.rest_positions
    )


def find_model_rigs(
    path: Path, info: ModelInfo, armature_object: bpy.types.Object | None = None
) -> dict[str, SceneRig]:
    """Find the rigs of the meshes of a model in the current scene, on one armature.

    Args:
        path, info: path and metadata of the model.
        armature_object: the armature object; None for that of the first mesh that is found.

    Returns:
        The rigs by the names of their meshes in the model, in the order of the model. Some may be missing.

    Raises:
        ModelError: the scene has none of the meshes.
    """
    objects = [o for o in bpy.context.scene.objects if o.type == "MESH" and not is_comparison(o)]
    rigs: dict[str, SceneRig] = {}
    # An object that has the name of a mesh comes before a copy of it.
    for mesh_object in sorted(objects, key=lambda o: all(o.name != mesh.name for mesh in info.meshes)):
        object_armature = armature_of(mesh_object)
        if object_armature is None or object_armature != (armature_object or object_armature):
            continue
        with suppress(ModelError):
            name = find_mesh(path, info, mesh_object)
            armature_object = object_armature
            rigs.setdefault(name, SceneRig(mesh_object, armature_object))
    if not rigs:
        names = format_with_noun([mesh.name for mesh in info.meshes], "mesh", "meshes")
        raise ModelError(f"The model '{path}' deforms {names}, and the scene has none on an armature; open its rig.")
    return {mesh.name: rigs[mesh.name] for mesh in info.meshes if mesh.name in rigs}


def describe_missing_meshes(info: ModelInfo, rigs: Container[str]) -> str:
    """Name the meshes of a model that `find_model_rigs` did not find; empty if it found all."""
    names = [mesh.name for mesh in info.meshes if mesh.name not in rigs]
    if not names:
        return ""
    return f"The model also deforms {format_with_noun(names, 'mesh', 'meshes')}, which the armature lacks here."
