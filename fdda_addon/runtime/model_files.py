# SPDX-License-Identifier: GPL-3.0-or-later
"""Loads each model once, and decides from which of the paths in a .blend file a model may be loaded."""

import os
from pathlib import Path

import bpy

from ..core.errors import ModelError, os_error_text
from ..core.formats.model import read_model
from ..scene.folder_trust import is_trusted
from ..scene.stored_paths import absolute_path, path_owner, resolve_path
from . import packed_model
from .model_meshes import find_mesh
from .network import Network
from .session import session


def network_of(mesh_object: bpy.types.Object) -> Network:
    """Return the model of a bound object, for its mesh: its packed model if there is one, else the model in its file.

    Raises:
        ModelError: the model cannot be loaded, or does not deform the mesh.
    """
    packed_text = mesh_object.fdda.packed
    network = load_network(model_path(mesh_object) if packed_text is None else packed_text)
    return network.of_mesh(find_mesh(network.path, network.info, mesh_object))


def load_network(source: Path | bpy.types.Text) -> Network:
    """Load a model once for all objects that use it, and again when its file has changed.

    Args:
        source: the path of the model, or the text datablock that holds it (`packed_model`).

    Raises:
        ModelError: the model cannot be loaded.
    """
    if isinstance(source, Path):
        try:
            status = os.stat(source)
        except OSError as error:
            raise ModelError(f"The model '{source}' cannot be read: {os_error_text(error)}; bind another.") from error
        key, state = source, (status.st_mtime_ns, status.st_size)
    else:
        key, state = source.session_uid, ()
    if key not in session.networks or session.networks[key][0] != state:
        is_file = isinstance(source, Path)
        network = Network(source) if is_file else Network(Path(source.name), packed_model.read(source))
        session.networks[key] = (state, network)
    return session.networks[key][1]


def release_unused_networks() -> None:
    """Free the models that no object of the open file is bound to."""
    bound_objects = [o for o in bpy.data.objects if o.type == "MESH" and o.fdda.is_bound]
    used_keys = {o.fdda.packed.session_uid if o.fdda.packed else absolute_path(o, o.fdda.model) for o in bound_objects}
    for key in session.networks.keys() - used_keys:
        del session.networks[key]


def model_path(mesh_object: bpy.types.Object) -> Path:
    """Return the absolute path of the model of a bound object.

    Raises:
        ModelError: as `allowed_path`.
    """
    return allowed_path(mesh_object, mesh_object.fdda.model)


def allowed_path(mesh_object: bpy.types.Object, stored_path: str) -> Path:
    """Return the absolute path of a model if a model may be loaded from there.

    Args:
        mesh_object: the object that stores the path.
        stored_path: the path as the object stores it.

    Raises:
        ModelError: the path leads out of the folder of the saved file, and the user has neither chosen the model nor
            trusted its folder.
    """
    path = absolute_path(mesh_object, stored_path)
    library = path_owner(mesh_object, stored_path).library
    blend_path = str(resolve_path(library.filepath)) if library else bpy.data.filepath
    # Resolved, because a path relative to the open file may contain "..".
    is_in_folder = not blend_path or path.resolve().is_relative_to(Path(blend_path).resolve().parent)
    if not (is_in_folder or path.resolve() in session.chosen_paths or is_trusted(path)):
        raise ModelError(
            f"The model '{path}' lies outside the folder of '{Path(blend_path).name}' and is not followed; "
            "choose it again and pack it, move it beside the file, or add its folder in the preferences."
        )
    return path


def allow_path(model_path: Path) -> None:
    """Allow loading a model that the user chose in this session from any folder."""
    session.chosen_paths.add(model_path.resolve())


def write_models(mesh_objects: list[bpy.types.Object], folder: Path) -> Path:
    """Return the file of the only model, or write the models of several meshes into a folder and return it.

    A packed model has no file that could be read.

    Raises:
        ModelError: a model cannot be read.
        OSError: a file cannot be written.
    """
    # Meshes of one character share a model.
    files: dict[bytes, Path] = {}
    for index, mesh_object in enumerate(mesh_objects):
        binding = mesh_object.fdda
        data = packed_model.read(binding.packed) if binding.packed else read_model(model_path(mesh_object))[1]
        if data not in files:
            # Clean names of different objects may be equal.
            file = files[data] = folder / str(index) / f"{bpy.path.clean_name(mesh_object.name)}.onnx"
            file.parent.mkdir()
            file.write_bytes(data)
    return folder if len(files) > 1 else next(iter(files.values()))
