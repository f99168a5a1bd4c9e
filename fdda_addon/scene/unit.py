# SPDX-License-Identifier: GPL-3.0-or-later
"""How long a unit of an object's space is: of the scene's unit scale and the object's own."""

import bpy
import numpy as np


def metres_per_unit(scene_object: bpy.types.Object) -> float:
    """The length of a unit of an object's space as scene and object are scaled now, metres.

    An object that is scaled by other factors along each axis counts as scaled by their geometric mean.

    Returns:
        Six digits: what Blender's single precision is good for, so that a metre is exactly 1.
    """
    settings = bpy.context.scene.unit_settings
    scale = settings.scale_length if settings.system != "NONE" else 1.0
    volume = abs(np.linalg.det(np.array(scene_object.matrix_world, np.float64)[:3, :3]))
    return float(f"{scale * volume ** (1 / 3):.6g}")
