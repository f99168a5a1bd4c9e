# SPDX-License-Identifier: GPL-3.0-or-later
"""Stores the paths of models and recordings in the open file, and remaps them when it is saved into another folder.

Blender then remaps the paths of its own data, but not the paths that an add-on stores.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import bpy
from bpy.app.handlers import persistent

RELATIVE_PREFIX = "//"
"""Start of a path that is relative to the folder of the .blend file."""


@dataclass
class _RunningSave:
    """A save between `save_pre` and `save_post`.

    Attributes:
        path_before: path of the open file before the save.
        paths: property group, property name, previous value and remapped value of each remapped path.
    """

    path_before: str
    paths: list[tuple[bpy.types.PropertyGroup, str, str, str]] = field(default_factory=list)


_running_saves: list[_RunningSave] = []
"""The running save; more than one if a handler of another add-on saves a copy during a save."""


def resolve_path(stored: str, library: bpy.types.Library | None = None) -> Path:
    """Make a path of a .blend file absolute, as Blender does.

    Args:
        stored: the path; `//` stands for the folder of the file.
        library: the linked file that has the path; None for the open file.
    """
    folder = resolve_path(library.filepath).parent if library else Path(bpy.data.filepath).parent
    if stored.startswith(RELATIVE_PREFIX):
        # Blender writes backslashes on Windows, and reads both separators on every system.
        stored = stored.replace("\\", "/")
    return Path(bpy.path.abspath(stored, start=str(folder)))


def absolute_path(mesh_object: bpy.types.Object, stored: str) -> Path:
    """Make a path that is stored with an object absolute, without checking whether its folder is trusted."""
    return Path(os.path.normpath(resolve_path(stored, path_owner(mesh_object, stored).library)))


def stored_path(path: Path) -> str:
    """Return a path as the open file stores it: relative to the file, if possible."""
    return _relative(path.absolute(), Path(bpy.data.filepath).parent) if bpy.data.filepath else str(path.absolute())


def stored_path_for(mesh_object: bpy.types.Object, path: Path) -> str:
    """Return a path as an object stores it; a library override stores a path of its library unchanged."""
    for stored in _inherited_paths(mesh_object):
        if stored and absolute_path(mesh_object, stored) == Path(os.path.normpath(path.absolute())):
            return stored
    return _distinct_from_inherited(mesh_object, stored_path(path))


def _distinct_from_inherited(mesh_object: bpy.types.Object, stored: str) -> str:
    """Return a path in a form that differs from all inherited paths, because those are relative to the library."""
    return (
        f"{RELATIVE_PREFIX}./{stored.removeprefix(RELATIVE_PREFIX)}"
        if stored in _inherited_paths(mesh_object)
        else stored
    )


def path_owner(mesh_object: bpy.types.Object, stored: str) -> bpy.types.Object:
    """Return the object that stores a path: for a path that a library override inherits, the object in the library."""
    while stored in _inherited_paths(mesh_object):
        mesh_object = mesh_object.override_library.reference
    return mesh_object


def _inherited_paths(mesh_object: bpy.types.Object) -> list[str]:
    """Return the paths that a library override inherits; empty for an object that is not a library override."""
    override = mesh_object.override_library
    if override is None or override.reference is None:
        return []
    binding = override.reference.fdda
    return [binding.model, *(entry.path for entry in binding.models)]


def _own_paths() -> Iterator[tuple[bpy.types.Object, bpy.types.PropertyGroup, str]]:
    """Yield the object, property group and property name of each path that is not inherited from a library."""
    for mesh_object in bpy.data.objects:
        if mesh_object.type != "MESH" or mesh_object.library is not None:
            continue
        binding, inherited = mesh_object.fdda, _inherited_paths(mesh_object)
        properties = [(binding, "model"), (binding.settings, "recording"), (binding.settings, "model")]
        for owner, name in [*properties, *((entry, "path") for entry in binding.models)]:
            stored = getattr(owner, name)
            if stored and stored not in inherited:
                yield mesh_object, owner, name


def _relative(path: Path, folder: Path) -> str:
    try:
        return bpy.path.relpath(str(path), start=str(folder)).replace(os.sep, "/")
    except ValueError:
        # The path is on another drive of Windows.
        return str(path)


@persistent
def _on_save_pre(file_path: str = "", *_: object) -> None:
    if _running_saves:
        # A handler of another add-on saves a backup: its paths are computed from the paths before the outer save.
        for owner, name, stored, _remapped in _running_saves[-1].paths:
            setattr(owner, name, stored)
    save = _RunningSave(bpy.data.filepath)
    _running_saves.append(save)
    folder = Path(os.path.abspath(file_path)).parent
    if not file_path or (save.path_before and folder == Path(os.path.normpath(save.path_before)).parent):
        return
    for mesh_object, owner, name in _own_paths():
        stored = getattr(owner, name)
        path = Path(os.path.normpath(resolve_path(stored)))
        # Absolute paths stay absolute, except paths into the folder into which the file is saved.
        if (stored.startswith(RELATIVE_PREFIX) and save.path_before) or path.is_relative_to(folder):
            remapped = _distinct_from_inherited(mesh_object, _relative(path, folder))
            save.paths.append((owner, name, stored, remapped))
            setattr(owner, name, remapped)


@persistent
def _on_save_post(*_: object) -> None:
    save = _running_saves.pop()
    # If a copy was saved or the save failed, the open file still has its previous path.
    if bpy.data.filepath == save.path_before:
        for owner, name, stored, _remapped in save.paths:
            setattr(owner, name, stored)
    if _running_saves:
        for owner, name, _stored, remapped in _running_saves[-1].paths:
            setattr(owner, name, remapped)


HANDLERS = {"save_pre": _on_save_pre, "save_post": _on_save_post, "save_post_fail": _on_save_post}
