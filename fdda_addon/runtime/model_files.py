# SPDX-License-Identifier: GPL-3.0-or-later
"""The networks of models, loaded once, and which paths of a .blend file are followed to a model."""

import os
from pathlib import Path

import bpy

from ..core.errors import ModelError, os_error_text
from ..scene.model_trust import is_trusted
from ..scene.stored_paths import absolute_path, origin, resolved
from . import packed_model
from .network import Network

_networks: dict[Path, tuple[tuple, Network]] = {}
_chosen: set[Path] = set()


def network_of(mesh_object: bpy.types.Object) -> Network:
    """The network of a bound object: of the model that is packed into the .blend file, else of its file.

    Raises:
        ModelError: it cannot be loaded.
    """
    binding = mesh_object.fdda
    return load_network(model_path(mesh_object)) if binding.packed is None else packed_model.load(binding.packed)


def load_network(path: Path) -> Network:
    """A network by its file, loaded once for all objects that use it and again when the file changes.

    Raises:
        ModelError: it cannot be loaded.
    """
    try:
        status = os.stat(path)
    except OSError as error:
        raise ModelError(f"The model '{path}' cannot be read: {os_error_text(error)}; bind another.") from error
    stamp = (status.st_mtime_ns, status.st_size)
    if path not in _networks or _networks[path][0] != stamp:
        _networks[path] = (stamp, Network(path))
    return _networks[path][1]


def release_unused() -> None:
    """Let go of the networks that no object of the open file is bound to: those of files that were open before."""
    bound = [o for o in bpy.data.objects if o.type == "MESH" and o.fdda.is_bound]
    used = {absolute_path(o, o.fdda.model) for o in bound if o.fdda.packed is None}
    for path in _networks.keys() - used:
        del _networks[path]
    packed_model.release_unused({o.fdda.packed.session_uid for o in bound if o.fdda.packed is not None})


def model_path(mesh_object: bpy.types.Object) -> Path:
    """Where the model of a binding is.

    Raises:
        ModelError: the path of a saved file leads out of the file's folder.
    """
    return allowed_path(mesh_object, mesh_object.fdda.model)


def allowed_path(mesh_object: bpy.types.Object, stored: str) -> Path:
    """The absolute path of a model that is stored with an object.

    Raises:
        ModelError: the path of a saved file leads out of the file's folder.
    """
    path = absolute_path(mesh_object, stored)
    library = origin(mesh_object, stored).library
    file = str(resolved(library.filepath)) if library else bpy.data.filepath
    # Resolved: the way from the open file to the model leads through "..".
    in_folder = not file or path.resolve().is_relative_to(Path(file).resolve().parent)
    if not (in_folder or path.resolve() in _chosen or is_trusted(path)):
        raise ModelError(
            f"The model '{path}' lies outside the folder of '{Path(file).name}' and is not followed; "
            "choose it again and pack it, move it beside the file, or trust its folder in the preferences."
        )
    return path


def choose(model: Path) -> None:
    """The user chose this model in this session: it may lie anywhere until the file is loaded again."""
    _chosen.add(model.resolve())
