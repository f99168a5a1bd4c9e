# SPDX-License-Identifier: GPL-3.0-or-later
"""What another add-on evaluates, and a shape key that the model does not know."""

from collections.abc import Iterator
from contextlib import contextmanager

import bpy
import numpy as np

from fdda_addon.runtime.binding import bind
from fdda_addon.runtime.model_files import model_path
from fdda_addon.scene.scene_rig import SceneRig, armature_of

from .conftest import (
    without_deformation,
)


@contextmanager
def handler(name: str, function) -> Iterator[None]:
    """Register a handler, as another add-on does, while the `with` block runs."""
    handlers = getattr(bpy.app.handlers, name)
    handlers.append(function)
    try:
        yield
    finally:
        handlers.remove(function)


def shown_in(graph: bpy.types.Depsgraph, mesh_object: bpy.types.Object) -> np.ndarray:
    mesh = mesh_object.evaluated_get(graph).data
    return np.array([vertex.co[:] for vertex in mesh.vertices], np.float32)


def add_shape_key(bound_elbow: bpy.types.Object) -> bpy.types.Object:
    """Add a shape key that the model was not trained with to the bound elbow, and return the elbow."""
    bind(SceneRig(bound_elbow, armature_of(bound_elbow)), without_deformation(model_path(bound_elbow)))
    bound_elbow.fdda.mode = "RIG"
    bound_elbow.shape_key_add(name="Basis")
    key = bound_elbow.shape_key_add(name="bulge")
    for point in key.data:
        point.co.z *= 1.2
    key.value = 1.0
    bound_elbow.fdda.mode = "FDDA"
    bpy.context.view_layer.update()
    return bound_elbow
