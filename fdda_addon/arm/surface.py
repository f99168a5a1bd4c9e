# SPDX-License-Identifier: GPL-3.0-or-later
"""The arm as arrays: rest points, quads, the bone of each vertex, the biceps. No bpy."""

from dataclasses import dataclass

import numpy as np

from .biceps import biceps_offsets
from .grid import build_grid
from .relax import relax
from .sculpt import arm_field
from .skin import main_joints

_ROUNDS = 40


@dataclass(frozen=True)
class Surface:
    """points (v, 3) float64, metres, arm space; faces (f, 4) int32, outward; joints (v,) int32 into `JOINTS`;
    biceps (v, 3) float64, offsets at full contraction, metres."""

    points: np.ndarray
    faces: np.ndarray
    joints: np.ndarray
    biceps: np.ndarray


def sculpt_arm(density: int) -> Surface:
    """The arm at density 1, 2 or 3 (about 1,450, 10,000 and 50,000 vertices); ValueError for any other."""
    grid = build_grid(density)
    field = arm_field()
    points = relax(grid, field, _ROUNDS)
    _, normals = field.distance_and_gradient(points)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Surface(points, grid.faces, main_joints(points, grid), biceps_offsets(points, normals))
