# SPDX-License-Identifier: GPL-3.0-or-later
"""The arm as arrays: rest positions, quads, bone of each vertex, biceps; without bpy."""

from dataclasses import dataclass, replace

import numpy as np

from .biceps import PEAK, biceps_offsets
from .digits import nail_faces
from .grid import build_grid
from .quads import interpolate_guide_points
from .relax import relax, smooth_loose_points
from .sculpt import arm_field
from .skin import main_joints

# Rounds of relaxation: the guide starts far from the skin, finer grids start on it.
_GUIDE_ROUNDS, _FINE_ROUNDS = 45, 11


@dataclass(frozen=True)
class Surface:
    """The surface of the arm.

    Attributes:
        points: (v, 3) float64, meters, arm space.
        faces: (f, 4) int32, outward.
        joints: (v,) int32 into `JOINTS`.
        biceps: (v, 3) float64, offsets at full contraction, meters.
        nails: (f,) bool, the faces of the nails.
    """

    points: np.ndarray
    faces: np.ndarray
    joints: np.ndarray
    biceps: np.ndarray
    nails: np.ndarray


def sculpt_arm(density: int) -> Surface:
    """Make the arm at density 1, 2 or 3 (about 1,450, 10,000 and 50,000 vertices); raise ValueError for others."""
    grid = build_grid(density)
    field = arm_field()
    guide = build_grid(1)
    points = relax(smooth_loose_points(guide), guide, field, _GUIDE_ROUNDS)
    if density > 1:
        seeds = interpolate_guide_points(grid, guide, points)
        # The guide has found where every ring belongs.
        points = relax(seeds, replace(grid, plane_point=seeds), field, _FINE_ROUNDS)
    _, normals = field.distance_and_gradient(points)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    joints = main_joints(points, grid)
    return Surface(points, grid.faces, joints, biceps_offsets(points, normals, PEAK[density]), nail_faces(grid))
