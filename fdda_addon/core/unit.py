# SPDX-License-Identifier: GPL-3.0-or-later
"""How long a unit of mesh-object space is, as recordings and models say it."""

import math

METRES_PER_UNIT = "metres_per_unit"
"""Key of `recording.json` and of a model's metadata, left out where a unit is a metre."""
UNIT_TOLERANCE = 1e-6


def unit_to_json(metres_per_unit: float) -> dict[str, float]:
    """What a file says of the unit: nothing where it is a metre."""
    return {} if abs(metres_per_unit - 1) <= UNIT_TOLERANCE else {METRES_PER_UNIT: metres_per_unit}


def read_unit(value: dict) -> float:
    """The length of a unit in metres, from what a file says.

    Raises:
        ValueError: it is no length.
    """
    metres = value.get(METRES_PER_UNIT, 1.0)
    if type(metres) not in (int, float) or not math.isfinite(metres) or metres <= 0:
        raise ValueError(f"'{METRES_PER_UNIT}' is {metres!r}, and a unit is longer than nothing")
    return float(metres)
