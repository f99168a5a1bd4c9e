# SPDX-License-Identifier: GPL-3.0-or-later
"""Keeps evaluations and colors while a file is opened again: Blender gives its objects new session ids.

They return to the object of the same name in the same file, if it is still bound to the same model.
"""

import os

import bpy
from bpy.app.handlers import persistent

from ..scene.stored_paths import absolute_path
from . import heat_map, last_evaluation


def _character_key(mesh_object: bpy.types.Object) -> tuple:
    """Return values by which a character and its bound model are recognized after the file was opened again."""
    binding = mesh_object.fdda
    model_state: tuple = (binding.packed.name, len(binding.packed.get("fdda_model", b""))) if binding.packed else ()
    if not model_state:
        try:
            status = os.stat(absolute_path(mesh_object, binding.model))
            model_state = (status.st_mtime_ns, status.st_size)
        except OSError:
            model_state = ()
    library = mesh_object.library.filepath if mesh_object.library else ""
    vertex_count = len(mesh_object.data.vertices)
    return (bpy.data.filepath, library, mesh_object.name, vertex_count, binding.model, model_state)


def _bound_objects() -> list[bpy.types.Object]:
    return [o for o in bpy.data.objects if o.type == "MESH" and o.fdda.is_bound]


@persistent
def _on_load_pre(*_: object) -> None:
    for mesh_object in _bound_objects() if bpy.data.filepath else []:
        evaluation = last_evaluation.get(mesh_object)
        if evaluation is not None:
            evaluation.closed_character = _character_key(mesh_object)
            evaluation.was_painted = heat_map.paint_kind(mesh_object) == heat_map.ERRORS


@persistent
def _on_load_post(*_: object) -> None:
    for mesh_object in _bound_objects():
        evaluation = last_evaluation.closed(_character_key(mesh_object))
        if evaluation is None:
            continue
        last_evaluation.restore(mesh_object, evaluation)
        if evaluation.was_painted:
            heat_map.paint_errors(mesh_object)


HANDLERS = {"load_pre": _on_load_pre, "load_post": _on_load_post}
