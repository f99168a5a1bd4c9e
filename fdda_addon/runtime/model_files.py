# SPDX-License-Identifier: GPL-3.0-or-later
"""Loads each model once, and decides from which of the paths in a .blend file a model may be loaded."""

import os
from pathlib import Path

import bpy

from ..core.errors import ModelError, os_error_text
from ..scene.folder_trust import is_trusted
from ..scene.stored_paths import absolute_path, path_owner, resolve_path
from . import packed_model
from .network import Network
from .session import session


def network_of(mesh_object: bpy.types.Object) -> Network:
    """Return the model of a bound object: its packed model if there is one, else the model in its file.

    Raises:
        ModelError: the model cannot be loaded.
    """
    binding = mesh_object.fdda
    return load_network(model_path(mesh_object)) if binding.packed is None else packed_model.load(binding.packed)


def load_network(path: Path) -> Network:
    """Load a model once for all objects that use it, and again when its file has changed.

    Raises:
        ModelError: the model cannot be loaded.
    """
    try:
        status = os.stat(path)
    except OSError as error:
        raise ModelError(f"The model '{path}' cannot be read: {os_error_text(error)}; bind another.") from error
    file_state = (status.st_mtime_ns, status.st_size)
    if path not in session.networks or session.networks[path][0] != file_state:
        session.networks[path] = (file_state, Network(path))
    return session.networks[path][1]


def release_unused_networks() -> None:
    """Free the models that no object of the open file is bound to."""
    bound_objects = [o for o in bpy.data.objects if o.type == "MESH" and o.fdda.is_bound]
    used_paths = {absolute_path(o, o.fdda.model) for o in bound_objects if o.fdda.packed is None}
    for path in session.networks.keys() - used_paths:
        del session.networks[path]
    used_texts = {o.fdda.packed.session_uid for o in bound_objects if o.fdda.packed is not None}
    packed_model.release_unused_networks(used_texts)


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
