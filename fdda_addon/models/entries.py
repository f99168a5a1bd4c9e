# SPDX-License-Identifier: GPL-3.0-or-later
"""The list of models that a mesh object keeps, as panels draw it: nothing is read from disk and numpy is not needed."""

import bpy


def active_entry(mesh_object: bpy.types.Object) -> bpy.types.PropertyGroup | None:
    """The entry that is chosen in the list, None when the list is empty."""
    binding = mesh_object.fdda
    if not binding.models:
        return None
    return binding.models[max(0, min(binding.model_index, len(binding.models) - 1))]


def is_bound(mesh_object: bpy.types.Object, entry: bpy.types.PropertyGroup) -> bool:
    """Whether an entry of the list is the model that is bound."""
    binding = mesh_object.fdda
    return binding.is_bound and binding.packed == entry.packed and binding.model == entry.path


def bound_entry(mesh_object: bpy.types.Object) -> bpy.types.PropertyGroup | None:
    """The entry of the model that is bound, None when it is not in the list."""
    return next((entry for entry in mesh_object.fdda.models if is_bound(mesh_object, entry)), None)


def bound_model_name(mesh_object: bpy.types.Object) -> str:
    """What the bound model is called."""
    entry = bound_entry(mesh_object)
    return entry.name if entry else bpy.path.display_name_from_filepath(mesh_object.fdda.model)


def format_file_size(count: int) -> str:
    """A size for people: "1.3 MB"."""
    return f"{count / 1e6:.1f} MB" if count >= 1e5 else f"{count / 1e3:.1f} kB"
