# SPDX-License-Identifier: GPL-3.0-or-later
"""The arm rig: a sculpted arm with 22 joints, hard skinning, a driven biceps and Corrective Smooth."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import bpy


def build_arm(density: int = 1) -> "tuple[bpy.types.Object, bpy.types.Object]":
    """Adds the arm and its rig to the current scene: (mesh object `arm`, armature object `arm_rig`).

    density: 1, 2 or 3 for about 1,450, 10,000 or 50,000 vertices; ValueError for anything else.
    """
    # Imported here, so that the joint table can be read where there is no bpy.
    from . import rig

    return rig.build_arm(density)


__all__ = ["build_arm"]
