# SPDX-License-Identifier: GPL-3.0-or-later
"""Entries in the list of models of a mesh object, for drawing: reads no files and needs no numpy."""

import bpy


def active_entry(mesh_object: bpy.types.Object) -> bpy.types.PropertyGroup | None:
    """Return the active entry of the list; None where the list is empty."""
    binding = mesh_object.fdda
    if not binding.models:
        return None
    return binding.models[max(0, min(binding.model_index, len(binding.models) - 1))]


def is_bound(mesh_object: bpy.types.Object, entry: bpy.types.PropertyGroup) -> bool:
    """Return whether an entry is the bound model."""
    binding = mesh_object.fdda
    return binding.is_bound and binding.packed == entry.packed and binding.model == entry.path


def bound_entry(mesh_object: bpy.types.Object) -> bpy.types.PropertyGroup | None:
    """Return the entry of the bound model; None where it is not in the list."""
    return next((entry for entry in mesh_object.fdda.models if is_bound(mesh_object, entry)), None)


def bound_model_name(mesh_object: bpy.types.Object) -> str:
    """Return the name of the bound model."""
    entry = bound_entry(mesh_object)
    return entry.name if entry else bpy.path.display_name_from_filepath(mesh_object.fdda.model)


def format_file_size(count: int) -> str:
    """Format a size in bytes: "1.3 MB"."""
    return f"{count / 1e6:.1f} MB" if count >= 1e5 else f"{count / 1e3:.1f} kB"
