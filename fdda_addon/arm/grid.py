# SPDX-License-Identifier: GPL-3.0-or-later
"""Builds the quads of the arm before sculpting: a tube from the shoulder to the webs, and five digits."""

from .digits import grow_fingers, grow_thumb
from .quads import DIVISIONS, Grid, GridBuilder
from .tube import Tube, add_tube


def build_grid(density: int) -> Grid:
    """Build the closed quad grid; raise ValueError for a density other than 1, 2 or 3."""
    if density not in DIVISIONS:
        raise ValueError(f"The arm has densities 1, 2 and 3; {density!r} is none of them.")
    quads, tube = GridBuilder(), Tube(DIVISIONS[density])
    rings = add_tube(quads, tube)
    grow_fingers(quads, tube, rings[-1])
    grow_thumb(quads, tube, rings)
    return quads.build()
