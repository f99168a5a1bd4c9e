# SPDX-License-Identifier: GPL-3.0-or-later
"""How the open file remembers where models and recordings are, also when it is saved into another folder.

Blender keeps the paths of its own data right then; those of an add-on it leaves as they are.
"""

import os
from collections.abc import Iterator
from pathlib import Path

import bpy
from bpy.app.handlers import persistent

RELATIVE = "//"

_rebased: list[tuple[bpy.types.PropertyGroup, str, str]] = []
"""During a save: property groups, names and former values of what was written for the folder that is saved into."""
_saved_from = ""


def resolve_path(stored: str, library: bpy.types.Library | None = None) -> Path:
    """Make a path of a .blend file absolute, as Blender does.

    Args:
        stored: the path; `//` stands for the folder of the file.
        library: the linked file that has the path; the open file when it is left out.
    """
    folder = resolve_path(library.filepath).parent if library else Path(bpy.data.filepath).parent
    if stored.startswith(RELATIVE):
        # Blender on Windows separates folders by backslashes, and reads both on every system.
        stored = stored.replace("\\", "/")
    return Path(bpy.path.abspath(stored, start=str(folder)))


def absolute_path(mesh_object: bpy.types.Object, stored: str) -> Path:
    """Where a path leads that is stored with an object, whether it is followed or not."""
    return Path(os.path.normpath(resolve_path(stored, path_owner(mesh_object, stored).library)))


def stored_path(path: Path) -> str:
    """How the open file remembers where a file is: relative to itself, where that can be said."""
    return _relative(path.absolute(), Path(bpy.data.filepath).parent) if bpy.data.filepath else str(path.absolute())


def stored_path_for(mesh_object: bpy.types.Object, path: Path) -> str:
    """How an object remembers where a file is; a library override calls the library's own as the library does."""
    for stored in _inherited_paths(mesh_object):
        if stored and absolute_path(mesh_object, stored) == Path(os.path.normpath(path.absolute())):
            return stored
    return _unlike_inherited(mesh_object, stored_path(path))


def _unlike_inherited(mesh_object: bpy.types.Object, stored: str) -> str:
    """The path in words that mean a file beside the open one: the library's own would mean that beside the library."""
    return f"{RELATIVE}./{stored.removeprefix(RELATIVE)}" if stored in _inherited_paths(mesh_object) else stored


def path_owner(mesh_object: bpy.types.Object, stored: str) -> bpy.types.Object:
    """The object that a path was stored with first: a library override may have it from its library."""
    while stored in _inherited_paths(mesh_object):
        mesh_object = mesh_object.override_library.reference
    return mesh_object


def _inherited_paths(mesh_object: bpy.types.Object) -> list[str]:
    """The paths that the object of which this is a library override knows; none where it is not."""
    override = mesh_object.override_library
    if override is None or override.reference is None:
        return []
    binding = override.reference.fdda
    return [binding.model, *(entry.path for entry in binding.models)]


def _own_paths() -> Iterator[tuple[bpy.types.Object, bpy.types.PropertyGroup, str]]:
    """Where a path is kept that is not a library's: the object, the property group, and the name."""
    for mesh_object in bpy.data.objects:
        if mesh_object.type != "MESH" or mesh_object.library is not None:
            continue
        binding, inherited = mesh_object.fdda, _inherited_paths(mesh_object)
        places = [(binding, "model"), (binding.settings, "recording"), (binding.settings, "model")]
        for owner, name in [*places, *((entry, "path") for entry in binding.models)]:
            stored = getattr(owner, name)
            if stored and stored not in inherited:
                yield mesh_object, owner, name


def _relative(path: Path, folder: Path) -> str:
    try:
        return bpy.path.relpath(str(path), start=str(folder)).replace(os.sep, "/")
    except ValueError:
        # On another drive of Windows.
        return str(path)


@persistent
def _on_save_begins(file: str = "", *_: object) -> None:
    global _saved_from
    _rebased.clear()
    _saved_from = bpy.data.filepath
    folder = Path(os.path.abspath(file)).parent
    if not file or (_saved_from and folder == Path(os.path.normpath(_saved_from)).parent):
        return
    for mesh_object, owner, name in _own_paths():
        stored = getattr(owner, name)
        path = Path(os.path.normpath(resolve_path(stored)))
        # What is given in full stays so, but for what goes wherever the file goes.
        if (stored.startswith(RELATIVE) and _saved_from) or path.is_relative_to(folder):
            _rebased.append((owner, name, stored))
            setattr(owner, name, _unlike_inherited(mesh_object, _relative(path, folder)))


@persistent
def _on_save_ended(*_: object) -> None:
    # The open file is still the former one where a copy was saved, or nothing.
    if bpy.data.filepath == _saved_from:
        for owner, name, stored in _rebased:
            setattr(owner, name, stored)
    _rebased.clear()


HANDLERS = {"save_pre": _on_save_begins, "save_post": _on_save_ended, "save_post_fail": _on_save_ended}
