# SPDX-License-Identifier: GPL-3.0-or-later
"""The entries in the model list of a mesh object, for panels. Nothing here reads files or imports numpy."""

import bpy


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
