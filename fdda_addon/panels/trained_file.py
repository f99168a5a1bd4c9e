# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the model file that the training of a character has written, and compares it with the rig."""

import os
from dataclasses import dataclass
from pathlib import Path

from ..core.errors import FDDAError
from ..core.formats.model import read_model_info
from ..core.rig import rig_differences
from ..properties.character import trained_file
from ..scene.draw_cache import computed_once, draw_cached
from ..scene.scene_rig import SceneRig
from . import checks
from .models import rig_of_model


@dataclass(frozen=True)
class TrainedFile:
    """A trained model file.

    Attributes:
        path: the file.
        mismatch: how the model differs from the rig; empty if it matches.
        skin_sentence: as `ModelInfo.skin_sentence`.
    """

    path: Path
    mismatch: str = ""
    skin_sentence: str = ""


def find_trained_file(rig: SceneRig) -> TrainedFile | None:
    """Return the model file that a training of this rig has written, even if it is not in the Model Library."""
    return _find_trained_file(rig)[0]


@draw_cached
def _find_trained_file(rig: SceneRig) -> tuple[TrainedFile | None]:
    """Return the result of `find_trained_file` in a tuple, because the cache does not store None."""
    path = trained_file(rig.mesh_object)
    check = checks.last_check(rig)
    if path is None:
        return (None,)
    if check is None or check.rig is None:
        return (TrainedFile(path),)
    status = os.stat(path)
    name, inputs = ("trained file", path), (status.st_mtime_ns, status.st_size, check.rig)
    return (computed_once(name, inputs, lambda: _read_trained_file(rig, check.rig, path)),)


def _read_trained_file(scene_rig: SceneRig, rig: object, path: Path) -> TrainedFile:
    try:
        info = read_model_info(path)
        current_rig = rig_of_model(scene_rig, rig, info)
        model_rig = (info.joints, info.rest_matrices, info.meshes)
        return TrainedFile(path, "; ".join(rig_differences(*model_rig, current_rig)), info.skin_sentence)
    except FDDAError as error:
        return TrainedFile(path, str(error))
