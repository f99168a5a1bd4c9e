# SPDX-License-Identifier: GPL-3.0-or-later
"""Stores the last measurements of each mesh object until another file is opened, for the sidebar."""

from typing import Any

import bpy
from bpy.app.handlers import persistent

_measurements: dict[tuple[str, int], Any] = {}
"""Results, by the verb that measures them and the session id of the mesh object."""


def store(verb: str, mesh_object: bpy.types.Object, result: object) -> None:
    """Store the result of a verb as the last of an object."""
    _measurements[verb, mesh_object.session_uid] = result


def last(verb: str, mesh_object: bpy.types.Object) -> Any:
    """Return the last result of a verb for an object; None if it was not measured."""
    return _measurements.get((verb, mesh_object.session_uid))


def remove(verb: str, mesh_object: bpy.types.Object) -> None:
    """Remove the last result of a verb for an object, because what it measured has changed."""
    _measurements.pop((verb, mesh_object.session_uid), None)


@persistent
def clear(*_: object) -> None:
    """Remove all results."""
    _measurements.clear()


HANDLERS = {"load_post": clear}
