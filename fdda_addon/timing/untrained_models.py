# SPDX-License-Identifier: GPL-3.0-or-later
"""The untrained model of a character, which measures how fast a trained model will be on this machine."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np

from ..core.errors import FDDAError
from ..core.files.temporary import temporary_folder
from ..core.formats.untrained_model import build_untrained_model
from ..rig.dependencies import read_dependencies
from ..rig.modifier_stack import check_evaluable
from ..rig.reading import read_rig
from ..rig.shape_keys import key_distances
from ..rig.time_inputs import check_time_inputs
from ..scene.scene_rig import SceneRig, join_rigs


@contextmanager
def untrained_models(
    rigs: Iterable[SceneRig],
) -> Iterator[tuple[dict[bpy.types.Object, Path], dict[bpy.types.Object, str]]]:
    """Write an untrained model of the meshes of an armature to a temporary folder; remove the folder afterwards.

    Yields:
        The path of the model, and why other meshes can have none, by mesh object.
    """
    rigs_of_model, reasons = [], {}
    for scene_rig in rigs:
        try:
            check_time_inputs(scene_rig, read_dependencies(scene_rig).controls, check_evaluable(scene_rig))
            read_rig(scene_rig)
        except FDDAError as error:
            reasons[scene_rig.mesh_object] = str(error)
        else:
            rigs_of_model.append(scene_rig)
    with temporary_folder() as folder:
        path = folder / "untrained.onnx"
        try:
            if rigs_of_model:
                character = join_rigs(rigs_of_model)
                dependencies = read_dependencies(character)
                rig = read_rig(character, dependencies.bones)
                distances = {}
                for mesh_object, vertices in zip(character.mesh_objects, rig.mesh_slices, strict=True):
                    for name, values in key_distances(character, mesh_object).items():
                        distances[name] = np.zeros(rig.vertex_count, np.float32)
                        distances[name][vertices] = values
                controls = (c for c in dependencies.controls if c.name not in distances or distances[c.name].any())
                path.write_bytes(build_untrained_model(replace(rig, controls=tuple(controls)), distances))
        except FDDAError as error:
            reasons |= {scene_rig.mesh_object: str(error) for scene_rig in rigs_of_model}
            rigs_of_model = []
        yield {scene_rig.mesh_object: path for scene_rig in rigs_of_model}, reasons
