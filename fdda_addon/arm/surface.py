# SPDX-License-Identifier: GPL-3.0-or-later
"""Builds the arm as arrays, without bpy: rest positions, quads, bone of each vertex, and biceps."""

from dataclasses import dataclass, replace

import numpy as np

from .biceps import PEAK_HEIGHTS, biceps_offsets
from .digits import grow_fingers, grow_thumb, nail_faces
from .quads import DIVISIONS, Grid, GridBuilder, interpolate_guide_points
from .relax import relax, smooth_loose_points
from .sculpt import arm_field
from .skin import assign_joints
from .tube import Tube, add_tube

# Rounds of relaxation. The guide starts far from the skin, and finer grids start on it.
_GUIDE_ROUNDS, _FINE_ROUNDS = 45, 11


@dataclass(frozen=True)
class Surface:
    """The surface of the arm.

    Attributes:
        points: (v, 3) float64, meters, arm space.
        faces: (f, 4) int32, oriented outwards.
        joints: (v,) int32, the index into `JOINTS` of the bone of each vertex.
        biceps: (v, 3) float64, offsets at full contraction, meters.
        nails: (f,) bool, whether a face is part of a nail.
    """

    points: np.ndarray
    faces: np.ndarray
    joints: np.ndarray
    biceps: np.ndarray
    nails: np.ndarray


def _build_grid(density: int) -> Grid:
    """Build the closed quad grid before sculpting: a tube from the shoulder to the webs, and five digits."""
    if density not in DIVISIONS:
        raise ValueError(f"The arm has densities 1, 2 and 3; {density!r} is none of them.")
    quads, tube = GridBuilder(), Tube(DIVISIONS[density])
    rings = add_tube(quads, tube)
    grow_fingers(quads, tube, rings[-1])
    grow_thumb(quads, tube, rings)
    return quads.build()


def sculpt_arm(density: int) -> Surface:
    """Build the arm at density 1, 2 or 3 (about 1,450, 10,000 and 50,000 vertices).

    Raises:
        ValueError: the density is not 1, 2 or 3.
    """
    grid = _build_grid(density)
    field = arm_field()
    guide = _build_grid(1)
    points = relax(smooth_loose_points(guide), guide, field, _GUIDE_ROUNDS)
    if density > 1:
        initial_points = interpolate_guide_points(grid, guide, points)
        # The rings keep the planes to which the relaxation of the guide has moved them.
        points = relax(initial_points, replace(grid, plane_point=initial_points), field, _FINE_ROUNDS)
    _, normals = field.distance_and_gradient(points)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    joints = assign_joints(points, grid)
    return Surface(points, grid.faces, joints, biceps_offsets(points, normals, PEAK_HEIGHTS[density]), nail_faces(grid))
