# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads the sculpted surface of the arm, `surface.npz`, which has each array for three densities."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

DENSITIES = (1, 2, 3)
"""Densities of the mesh, with about 1,450, 10,000 and 50,000 vertices."""


@dataclass(frozen=True)
class Surface:
    """The surface of the arm, one closed surface of quads.

    Attributes:
        points: (v, 3) float32, rest positions, meters, arm space (see `joints`).
        contracted: (v, 3) float32, the same with a contracted biceps.
        faces: (f, 4) int32, oriented outwards.
        joints: (v,) int32, index into `joints.JOINTS` of the bone of each vertex.
        nails: (f,) bool, whether a face is part of a nail.
    """

    points: np.ndarray
    contracted: np.ndarray
    faces: np.ndarray
    joints: np.ndarray
    nails: np.ndarray


def read_surface(density: int) -> Surface:
    """Read the surface of a density in `DENSITIES`."""
    if density not in DENSITIES:
        raise ValueError(f"The arm has densities 1, 2 and 3; {density!r} is none of them.")
    with np.load(Path(__file__).with_name("surface.npz"), allow_pickle=False) as arrays:
        names = ("points", "face_steps", "joints", "nails", "biceps_vertices", "biceps_points")
        points, face_steps, joints, nails, biceps_vertices, biceps_points = (arrays[f"{n}_{density}"] for n in names)
    contracted = points.copy()
    contracted[biceps_vertices] = biceps_points
    # The file has the differences between faces, which compress well.
    faces = face_steps.cumsum(axis=0, dtype=face_steps.dtype).astype(np.int32)
    return Surface(points, contracted, faces, joints.astype(np.int32), nails)
