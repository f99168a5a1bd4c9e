# SPDX-License-Identifier: GPL-3.0-or-later
"""The quads of the whole arm before they are sculpted: a tube from shoulder to webs, five digits growing out of it."""

from .digits import grow_fingers, grow_thumb
from .quads import DIVISIONS, Collector, Grid
from .tube import Tube, lay_tube


def build_grid(density: int) -> Grid:
    """Closed, all quads; ValueError for a density other than 1, 2 or 3."""
    if density not in DIVISIONS:
        raise ValueError(f"The arm has densities 1, 2 and 3; {density!r} is none of them.")
    quads, tube = Collector(), Tube(DIVISIONS[density])
    rings = lay_tube(quads, tube)
    grow_fingers(quads, tube, rings[-1])
    grow_thumb(quads, tube, rings)
    return quads.grid()
