# SPDX-License-Identifier: GPL-3.0-or-later
"""The model that a training of a character has written: whether it is there, and whether it is of this rig."""

import os
from dataclasses import dataclass
from pathlib import Path

from ..core.errors import FDDAError
from ..properties.character import trained_file
from ..scene.draw_cache import draw_cached
from ..scene.scene_rig import SceneRig
from . import checks

_checked: dict[tuple, str] = {}
"""Why models do not fit, by file, its time and size, and the check of the rig; empty for those that fit."""


@dataclass(frozen=True)
class Trained:
    """A model where the training of a character writes it: its file, and why it is not of this rig, empty if it is."""

    path: Path
    foreign: str = ""


def trained(rig: SceneRig) -> Trained | None:
    """The model that a training of this rig has written, also where an undo has taken it off the list."""
    return _trained(rig)[0]


@draw_cached
def _trained(rig: SceneRig) -> tuple[Trained | None]:
    """As `trained`; in a tuple, for that there is none is kept as well."""
    path = trained_file(rig.mesh_object)
    check = checks.known(rig)
    if path is None:
        return (None,)
    if check is None or check.rig is None:
        return (Trained(path),)
    status = os.stat(path)
    key = (path, status.st_mtime_ns, status.st_size, id(check.rig))
    if key not in _checked:
        _checked.clear()
        _checked[key] = _foreign(rig, check.rig, path)
    return (Trained(path, _checked[key]),)


def _foreign(scene_rig: SceneRig, rig: object, path: Path) -> str:
    from ..core.model import read_model_info
    from ..core.rig import rig_differences
    from .models import rig_of_model

    try:
        info = read_model_info(path)
        own = rig_of_model(scene_rig, rig, info)
        return "; ".join(rig_differences(info.joints, info.rest_matrices, info.vertex_count, info.fingerprint, own))
    except FDDAError as error:
        return str(error)
