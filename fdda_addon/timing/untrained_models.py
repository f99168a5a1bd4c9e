# SPDX-License-Identifier: GPL-3.0-or-later
"""Untrained models of the meshes of a character, which measure how fast trained models will be on this machine."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import bpy

from ..core.errors import FDDAError
from ..core.files.temporary import temporary_folder
from ..core.formats.untrained_model import build_untrained_model
from ..rig.dependencies import read_dependencies
from ..rig.modifier_stack import check_evaluable
from ..rig.reading import read_rig
from ..rig.shape_keys import key_distances
from ..rig.time_inputs import check_time_inputs
from ..scene.scene_rig import SceneRig


@contextmanager
def untrained_models(
    rigs: Iterable[SceneRig],
) -> Iterator[tuple[dict[bpy.types.Object, Path], dict[bpy.types.Object, str]]]:
    """Write an untrained model of each rig to a temporary folder; remove the folder afterwards.

    Yields:
        The paths of the models, and why the other rigs can have none, by mesh object.
    """
    models, reasons = {}, {}
    with temporary_folder() as folder:
        for scene_rig in rigs:
            mesh_object, path = scene_rig.mesh_object, folder / f"untrained_{len(models)}.onnx"
            try:
                stack = check_evaluable(scene_rig)
                distances, dependencies = key_distances(mesh_object), read_dependencies(scene_rig)
                controls = tuple(c for c in dependencies.controls if c.path not in distances or distances[c.path].any())
                check_time_inputs(scene_rig, controls, stack)
                rig = replace(read_rig(scene_rig, dependencies.bones), controls=controls)
                path.write_bytes(build_untrained_model(rig, distances))
            except FDDAError as error:
                reasons[mesh_object] = str(error)
            else:
                models[mesh_object] = path
        yield models, reasons
