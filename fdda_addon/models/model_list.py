# SPDX-License-Identifier: GPL-3.0-or-later
"""The list of models of a mesh object: adding, binding, packing and removing of models."""

import os
from pathlib import Path

import bpy

from ..core.errors import ModelError, OutputError, os_error_text
from ..core.model import MAX_BYTES, ModelInfo, check_model, read_model, read_model_info
from ..core.output import atomic_write, check_writable
from ..evaluation import last_evaluation
from ..runtime import model_files, packed_model, playback, registry
from ..runtime.binding import bind, unbind
from ..runtime.opened_model import read_matching_rig
from ..scene.scene_rig import SceneRig
from ..scene.stored_paths import absolute_path, stored_path_for
from ..timing import frame_times
from .entries import active_entry, bound_entry, bound_model_name, is_bound

_info_cache: dict[tuple, ModelInfo] = {}


def add_model(mesh_object: bpy.types.Object, path: Path) -> bpy.types.PropertyGroup:
    """Add a model to the list of its mesh and make it active.

    Returns:
        The entry, an existing one for the same file. A changed file is packed again where it is packed, and loaded
        again where it is bound.

    Raises:
        ModelError: a packed model changed, and its file cannot be read or is no model.
    """
    binding = mesh_object.fdda
    model_files.allow(path)
    for index, entry in enumerate(binding.models):
        if absolute_path(mesh_object, entry.path) == Path(os.path.normpath(path.absolute())):
            binding.model_index = index
            was_bound = is_bound(mesh_object, entry)
            is_changed = (
                _repack_if_changed(mesh_object, entry, path)
                if entry.packed
                else playback.has_outdated_model(mesh_object)
            )
            if was_bound and is_changed:
                last_evaluation.remove(mesh_object)
                frame_times.remove(mesh_object)
                registry.reset_players()
                mesh_object.update_tag()
            return entry
    entry = binding.models.add()
    entry.name = path.stem
    entry.path = stored_path_for(mesh_object, path)
    binding.model_index = len(binding.models) - 1
    return entry


def add_bound_model(mesh_object: bpy.types.Object) -> None:
    """Add the bound model to the list where a script or the command line has bound it."""
    binding = mesh_object.fdda
    if binding.is_bound and bound_entry(mesh_object) is None:
        entry = binding.models.add()
        entry.name, entry.path, entry.packed = bound_model_name(mesh_object), binding.model, binding.packed
        entry.packed_bytes = len(packed_model.read(binding.packed)) if binding.packed else 0


def require_active_entry(mesh_object: bpy.types.Object) -> bpy.types.PropertyGroup:
    """Return the active entry of the list.

    Raises:
        ModelError: the list is empty.
    """
    entry = active_entry(mesh_object)
    if entry is None:
        raise ModelError(f"'{mesh_object.name}' has no model yet; train one, or choose a file.")
    return entry


def check_matches_rig(scene_rig: SceneRig, path: Path) -> None:
    """Check that a file is a model of this rig.

    Raises:
        FDDAError: it is no model, or of another rig.
    """
    read_matching_rig(scene_rig, path, read_model_info(path))


def bind_entry(scene_rig: SceneRig, entry: bpy.types.PropertyGroup) -> None:
    """Bind a model of the list in place of the bound one.

    Raises:
        FDDAError: as `bind`, or the model cannot play; the previous model is bound again.
    """
    mesh_object = scene_rig.mesh_object
    _bind(scene_rig, entry_path(mesh_object, entry), entry.packed)
    entry.path = mesh_object.fdda.model
    mesh_object.fdda.model_index = list(mesh_object.fdda.models).index(entry)


def _bind(scene_rig: SceneRig, path: Path, packed_text: bpy.types.Text | None = None) -> None:
    """Bind a model as `bind_entry` does, without changing the list."""
    mesh_object, binding = scene_rig.mesh_object, scene_rig.mesh_object.fdda
    use_in_render = binding.use_in_render
    previous = (binding.model, binding.packed, binding.mode) if binding.is_bound else None
    bind(scene_rig, path, use_in_render, packed_text)
    # Evaluate now, so that a model that cannot play is an error here and not at the next frame.
    bpy.context.view_layer.update()
    if problem := binding.status:
        is_changed = previous is not None and previous[:2] != (binding.model, binding.packed)
        unbind(mesh_object)
        if is_changed:
            model, packed_before, mode = previous
            bind(scene_rig, absolute_path(mesh_object, model), use_in_render, packed_before)
            binding.model, binding.mode = model, mode
        raise ModelError(problem)


def relink(scene_rig: SceneRig, path: Path) -> None:
    """Bind the new location of the bound model, and update its entry.

    Raises:
        FDDAError: as `bind_entry`; the list is unchanged.
    """
    mesh_object = scene_rig.mesh_object
    entry = bound_entry(mesh_object)
    index = list(mesh_object.fdda.models).index(entry) if entry else -1
    _bind(scene_rig, path)
    model_files.allow(path)
    if index < 0:
        add_model(mesh_object, path)
        return
    entry, mesh_object.fdda.model_index = mesh_object.fdda.models[index], index
    entry.path, entry.packed, entry.packed_bytes = mesh_object.fdda.model, None, 0
    packed_model.remove_unused()


def remove_entry(mesh_object: bpy.types.Object, index: int) -> str:
    """Remove a model from the list, and unbind it where it is bound; return its name. Its file is kept.

    Raises:
        ModelError: the entry belongs to the library of an override.
    """
    binding = mesh_object.fdda
    entry = binding.models[index]
    name = entry.name
    override = mesh_object.override_library
    if override is not None and override.reference is not None and index < len(override.reference.fdda.models):
        file = Path(override.reference.library.filepath).name
        raise ModelError(f"The model '{name}' is in the list of '{file}'; remove it there, or unbind it here.")
    if is_bound(mesh_object, entry):
        unbind(mesh_object)
    binding.models.remove(index)
    binding.model_index = max(0, min(binding.model_index, len(binding.models) - 1))
    packed_model.remove_unused()
    return name


def pack_entry(mesh_object: bpy.types.Object, entry: bpy.types.PropertyGroup, path: Path | None = None) -> int:
    """Pack a model of the list into the .blend file; return its size in bytes.

    Args:
        mesh_object, entry: the model.
        path: of its file; None for the path of the entry.

    Raises:
        ModelError: its file cannot be read or is no model.
    """
    path = path or entry_path(mesh_object, entry)
    bound = is_bound(mesh_object, entry)
    data = read_model(path)[1]
    entry.packed, entry.packed_bytes = packed_model.pack(path.name, data), len(data)
    if bound:
        mesh_object.fdda.packed = entry.packed
        registry.reset_players()
    return len(data)


def _repack_if_changed(mesh_object: bpy.types.Object, entry: bpy.types.PropertyGroup, path: Path) -> bool:
    """Pack the file of a packed model again where it has changed; return whether it has."""
    if entry.packed.get(packed_model.PACKED_MODEL_KEY) == read_model(path)[1]:
        return False
    pack_entry(mesh_object, entry, path)
    packed_model.remove_unused()
    return True


def unpack_entry(mesh_object: bpy.types.Object, entry: bpy.types.PropertyGroup, path: Path) -> None:
    """Write a packed model to a file, and use this file from now on.

    Raises:
        ModelError: the packed data is no valid model.
        OutputError: the file cannot be written, or another file exists.
    """
    data = packed_model.read(entry.packed)
    check_model(data, entry.packed.name)
    check_writable(path)
    if not (os.path.lexists(path) and path.is_file() and _has_content(path, data)):
        if os.path.lexists(path):
            raise OutputError(f"There is another file '{path}'; choose another name.")
        with atomic_write(path) as temporary:
            temporary.write_bytes(data)
    bound = is_bound(mesh_object, entry)
    entry.path, entry.packed, entry.packed_bytes = stored_path_for(mesh_object, path), None, 0
    model_files.allow(path)
    if bound:
        mesh_object.fdda.model, mesh_object.fdda.packed = entry.path, None
        registry.reset_players()
    packed_model.remove_unused()


def entry_path(mesh_object: bpy.types.Object, entry: bpy.types.PropertyGroup) -> Path:
    """Return the path of the model of an entry, or its path before packing.

    Raises:
        ModelError: the path in a saved file leads out of the file's folder.
    """
    return absolute_path(mesh_object, entry.path) if entry.packed else model_files.allowed_path(mesh_object, entry.path)


def entry_info(mesh_object: bpy.types.Object, entry: bpy.types.PropertyGroup) -> ModelInfo:
    """Return the cached metadata of a model of the list.

    Raises:
        ModelError: the model cannot be read or is invalid.
    """
    if entry.packed:
        key = (entry.packed.session_uid,)
        if key not in _info_cache:
            _info_cache[key] = check_model(packed_model.read(entry.packed), entry.packed.name)
        return _info_cache[key]
    path = entry_path(mesh_object, entry)
    try:
        status = os.stat(path)
    except OSError as error:
        raise ModelError(
            f"The model '{path}' cannot be read: {os_error_text(error)}; find it, or choose another."
        ) from error
    key = (path, status.st_mtime_ns, status.st_size)
    if key not in _info_cache:
        for old in [old for old in _info_cache if old[0] == path]:
            del _info_cache[old]
        _info_cache[key] = read_model_info(path)
    return _info_cache[key]


def _has_content(path: Path, data: bytes) -> bool:
    return path.stat().st_size == len(data) <= MAX_BYTES and path.read_bytes() == data
