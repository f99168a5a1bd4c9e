# SPDX-License-Identifier: GPL-3.0-or-later
"""Computes the length of a unit of an object's space from the scales of scene and object."""

import bpy
import numpy as np


def metres_per_unit(scene_object: bpy.types.Object) -> float:
    """Compute the length of a unit of an object's space, in meters, with the current scales of scene and object.

    For an object with different scales along its axes, it uses their geometric mean.

    Returns:
        The length, rounded to the six digits of Blender's numbers, so that the length of a meter is exactly 1.
    """
    settings = bpy.context.scene.unit_settings
    scale = settings.scale_length if settings.system != "NONE" else 1.0
    volume = abs(np.linalg.det(np.array(scene_object.matrix_world, np.float64)[:3, :3]))
    return float(f"{scale * volume ** (1 / 3):.6g}")
