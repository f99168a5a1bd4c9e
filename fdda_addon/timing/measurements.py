# SPDX-License-Identifier: GPL-3.0-or-later
"""Stores the last measurements of each character until another file is opened, for the sidebar."""

from collections.abc import Mapping
from typing import Any

import bpy
from bpy.app.handlers import persistent

from ..scene.draw_cache import draw_cached
from ..scene.scene_rig import rigs_of_armature

_measurements: dict[tuple[str, int], tuple[Mapping, Any]] = {}
"""`models_of` and the result, by the verb that measures it and the session id of the armature object."""
MEASURE, PROFILE = "measure", "profile_frame"
"""Verbs that measure."""


def store(verb: str, armature_object: bpy.types.Object, result: object) -> None:
    """Store the result of a verb as the last of a character."""
    _measurements[verb, armature_object.session_uid] = (models_of(armature_object), result)


def last(verb: str, armature_object: bpy.types.Object) -> Any:
    """Return the last result of a verb for a character; None if there is none with its current meshes and models."""
    models, result = _measurements.get((verb, armature_object.session_uid), (None, None))
    return result if models == models_of(armature_object) else None


@draw_cached
def models_of(armature_object: bpy.types.Object) -> Mapping[str, tuple[int, str]]:
    """Return the number of vertices and the bound model of each mesh of a character, by name."""
    meshes = [rig.mesh_object for rig in rigs_of_armature(armature_object)]
    return {o.name: (len(o.data.vertices), o.fdda.model if o.fdda.is_bound else "") for o in meshes}


def remove(armature_object: bpy.types.Object) -> None:
    """Remove the last results of a character, because a model has changed."""
    for verb in (MEASURE, PROFILE):
        _measurements.pop((verb, armature_object.session_uid), None)


@persistent
def clear(*_: object) -> None:
    """Remove all results."""
    _measurements.clear()


HANDLERS = {"load_post": clear}
