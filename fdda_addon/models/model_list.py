# SPDX-License-Identifier: GPL-3.0-or-later
"""The model list of a mesh object: adds, binds, packs and removes models."""

import os
from pathlib import Path

import bpy

from ..core.errors import ModelError, OutputError, os_error_text
from ..core.files.output import atomic_write, check_writable
from ..core.formats.model import check_model, read_model, read_model_info
from ..core.formats.model_info import ModelInfo
from ..evaluation import last_evaluation
from ..runtime import model_files, packed_model, playback
from ..runtime.binding import bind, check_plays, unbind
from ..runtime.model_meshes import info_of_mesh
from ..runtime.opened_model import read_matching_rig
from ..scene.draw_cache import computed_once
from ..scene.scene_rig import SceneRig, armature_of
from ..scene.stored_paths import absolute_path, stored_path_for
from ..timing import measurements


def active_entry(mesh_object: bpy.types.Object) -> bpy.types.PropertyGroup | None:
    """Return the active entry of the list; None if the list is empty."""
    binding = mesh_object.fdda
    if not binding.models:
        return None
    return binding.models[max(0, min(binding.model_index, len(binding.models) - 1))]


def is_bound(mesh_object: bpy.types.Object, entry: bpy.types.PropertyGroup) -> bool:
    """Return whether an entry is the bound model."""
    binding = mesh_object.fdda
    return binding.is_bound and binding.packed == entry.packed and binding.model == entry.path


def bound_entry(mesh_object: bpy.types.Object) -> bpy.types.PropertyGroup | None:
    """Return the entry of the bound model; None if the model is not in the list."""
    return next((entry for entry in mesh_object.fdda.models if is_bound(mesh_object, entry)), None)


def bound_model_name(mesh_object: bpy.types.Object) -> str:
    """Return the name of the bound model."""
    entry = bound_entry(mesh_object)
    return entry.name if entry else bpy.path.display_name_from_filepath(mesh_object.fdda.model)


def format_file_size(byte_count: int) -> str:
    """Format a number of bytes as text such as "1.3 MB"."""
    return f"{byte_count / 1e6:.1f} MB" if byte_count >= 1e5 else f"{byte_count / 1e3:.1f} kB"


def add_model(mesh_object: bpy.types.Object, path: Path) -> bpy.types.PropertyGroup:
    """Add a model file to the list of a mesh object and make its entry active.

    If the list already has the file, the existing entry is used. If the file has changed, a packed model is packed
    again, and a bound model is loaded again.

    Returns:
        The entry.

    Raises:
        ModelError: the entry is packed, and the file cannot be read or is not a model.
    """
    binding = mesh_object.fdda
    model_files.allow_path(path)
    for index, entry in enumerate(binding.models):
        if absolute_path(mesh_object, entry.path) == Path(os.path.normpath(path.absolute())):
            binding.model_index = index
            was_bound = is_bound(mesh_object, entry)
            if not entry.packed:
                is_changed = playback.has_outdated_model(mesh_object)
            elif is_changed := entry.packed.get(packed_model.PACKED_MODEL_KEY) != read_model(path)[1]:
                pack_entry(mesh_object, entry, path)
                packed_model.remove_unused_texts()
            if was_bound and is_changed:
                last_evaluation.remove(mesh_object)
                if (armature_object := armature_of(mesh_object)) is not None:
                    measurements.remove(armature_object)
                playback.reload_model(mesh_object)
                mesh_object.update_tag()
            return entry
    entry = binding.models.add()
    entry.name = path.stem
    entry.path = stored_path_for(mesh_object, path)
    binding.model_index = len(binding.models) - 1
    return entry


def copy_entry(
    mesh_object: bpy.types.Object, source_object: bpy.types.Object, source: bpy.types.PropertyGroup
) -> bpy.types.PropertyGroup:
    """Add a model in the list of another mesh object to the list of a mesh object, and make its entry active.

    If the list already has the model, the existing entry is used.
    """
    binding = mesh_object.fdda
    path = absolute_path(source_object, source.path)
    entry = next((entry for entry in binding.models if absolute_path(mesh_object, entry.path) == path), None)
    if entry is None:
        entry = binding.models.add()
        entry.name, entry.path = source.name, stored_path_for(mesh_object, path)
    entry.packed, entry.packed_bytes = source.packed, source.packed_bytes
    binding.model_index = list(binding.models).index(entry)
    return entry


def add_bound_model(mesh_object: bpy.types.Object) -> None:
    """Add the bound model to the list if it is missing there, because a script or the command line has bound it."""
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
    """Check that a file is a model that was trained for a rig.

    Raises:
        FDDAError: the file is not a model, or the model was trained for another rig.
    """
    read_matching_rig(scene_rig, path, read_model_info(path))


def bind_entry(scene_rig: SceneRig, entry: bpy.types.PropertyGroup) -> str:
    """Bind a model of the list in place of the bound one, and return the sentence of `bind`.

    Raises:
        FDDAError: as `bind`, or because the model cannot play. The previous model is bound again.
    """
    mesh_object = scene_rig.mesh_object
    note = _bind(scene_rig, entry_path(mesh_object, entry), entry.packed)
    entry.path = mesh_object.fdda.model
    mesh_object.fdda.model_index = list(mesh_object.fdda.models).index(entry)
    return note


def _bind(scene_rig: SceneRig, path: Path, packed_text: bpy.types.Text | None = None) -> str:
    """Bind a model as `bind_entry` does, without changing the list."""
    mesh_object, binding = scene_rig.mesh_object, scene_rig.mesh_object.fdda
    use_in_render = binding.use_in_render
    previous_binding = (binding.model, binding.packed, binding.mode) if binding.is_bound else None
    note = bind(scene_rig, path, use_in_render, packed_text)
    # Evaluate now, so that a model that cannot play raises the error here and not in the next frame.
    try:
        check_plays(mesh_object)
    except ModelError:
        has_other_model = previous_binding is not None and previous_binding[:2] != (binding.model, binding.packed)
        unbind(mesh_object)
        if has_other_model:
            previous_model, previous_text, previous_mode = previous_binding
            bind(scene_rig, absolute_path(mesh_object, previous_model), use_in_render, previous_text)
            binding.model, binding.mode = previous_model, previous_mode
        raise
    return note


def relink(scene_rig: SceneRig, path: Path) -> None:
    """Bind the new location of the bound model, and update its entry.

    Raises:
        FDDAError: as `bind_entry`. The list is unchanged.
    """
    mesh_object = scene_rig.mesh_object
    entry = bound_entry(mesh_object)
    index = list(mesh_object.fdda.models).index(entry) if entry else -1
    _bind(scene_rig, path)
    model_files.allow_path(path)
    if index < 0:
        add_model(mesh_object, path)
        return
    entry, mesh_object.fdda.model_index = mesh_object.fdda.models[index], index
    entry.path, entry.packed, entry.packed_bytes = mesh_object.fdda.model, None, 0
    packed_model.remove_unused_texts()


def remove_entry(mesh_object: bpy.types.Object, index: int) -> str:
    """Remove a model from the list, unbind it if it is bound, and return its name. Its file stays on disk.

    Raises:
        ModelError: the entry belongs to the library of an override.
    """
    binding = mesh_object.fdda
    entry = binding.models[index]
    name = entry.name
    override = mesh_object.override_library
    if override is not None and override.reference is not None and index < len(override.reference.fdda.models):
        library_name = Path(override.reference.library.filepath).name
        raise ModelError(f"The model '{name}' is in the list of '{library_name}'; remove it there, or unbind it here.")
    if is_bound(mesh_object, entry):
        unbind(mesh_object)
    binding.models.remove(index)
    binding.model_index = max(0, min(binding.model_index, len(binding.models) - 1))
    packed_model.remove_unused_texts()
    return name


def pack_entry(mesh_object: bpy.types.Object, entry: bpy.types.PropertyGroup, path: Path | None = None) -> int:
    """Pack a model of the list into the .blend file; return its size in bytes.

    Args:
        mesh_object: the mesh object with the list.
        entry: the entry of the model.
        path: path of the model file; None for the path of the entry.

    Raises:
        ModelError: the file cannot be read or is not a model.
    """
    path = path or entry_path(mesh_object, entry)
    was_bound = is_bound(mesh_object, entry)
    data = read_model(path)[1]
    entry.packed, entry.packed_bytes = packed_model.pack(path.name, data), len(data)
    if was_bound:
        mesh_object.fdda.packed = entry.packed
        playback.reload_model(mesh_object)
    return len(data)


def unpack_entry(mesh_object: bpy.types.Object, entry: bpy.types.PropertyGroup, path: Path) -> None:
    """Write a packed model to a file, and use the file instead of the packed model.

    Raises:
        ModelError: the packed data is not a valid model.
        OutputError: the file cannot be written, or another file exists.
    """
    data = packed_model.read(entry.packed)
    check_model(data, entry.packed.name)
    check_writable(path)
    if not os.path.lexists(path):
        with atomic_write(path) as temporary:
            temporary.write_bytes(data)
    elif not path.is_file() or path.stat().st_size != len(data) or path.read_bytes() != data:
        raise OutputError(f"There is another file '{path}'; choose another name.")
    was_bound = is_bound(mesh_object, entry)
    entry.path, entry.packed, entry.packed_bytes = stored_path_for(mesh_object, path), None, 0
    model_files.allow_path(path)
    if was_bound:
        mesh_object.fdda.model, mesh_object.fdda.packed = entry.path, None
        playback.reload_model(mesh_object)
    packed_model.remove_unused_texts()


def entry_path(mesh_object: bpy.types.Object, entry: bpy.types.PropertyGroup) -> Path:
    """Return the path of the model file of an entry; for a packed model, the path that it was packed from.

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
        text = entry.packed
        name = ("packed model", text.session_uid)
        return computed_once(name, (), lambda: check_model(packed_model.read(text), text.name))
    path = entry_path(mesh_object, entry)
    try:
        file_status = os.stat(path)
    except OSError as error:
        raise ModelError(
            f"The model '{path}' cannot be read: {os_error_text(error)}; find it, or choose another."
        ) from error
    inputs = (file_status.st_mtime_ns, file_status.st_size)
    return computed_once(("model", path), inputs, lambda: read_model_info(path))


def entry_info_of_mesh(mesh_object: bpy.types.Object, entry: bpy.types.PropertyGroup) -> ModelInfo:
    """Return the metadata of a model of the list for its mesh; raise the errors of `entry_info` and `find_mesh`."""
    return info_of_mesh(entry_path(mesh_object, entry), entry_info(mesh_object, entry), mesh_object)
