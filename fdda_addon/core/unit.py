# SPDX-License-Identifier: GPL-3.0-or-later
"""The length of a unit of mesh-object space in recordings and models."""

import math

METRES_PER_UNIT = "metres_per_unit"
"""Key of `recording.json` and of a model's metadata; left out where a unit is one metre."""
UNIT_TOLERANCE = 1e-6
"""A unit counts as one metre within this difference, metres."""


def unit_to_json(metres_per_unit: float) -> dict[str, float]:
    """Return the JSON entry of the unit; empty where a unit is one metre."""
    return {} if abs(metres_per_unit - 1) <= UNIT_TOLERANCE else {METRES_PER_UNIT: metres_per_unit}


def read_unit(value: dict) -> float:
    """Read the length of a unit in metres from the JSON of a file.

    Raises:
        ValueError: the entry is not a positive number.
    """
    metres = value.get(METRES_PER_UNIT, 1.0)
    if type(metres) not in (int, float) or not math.isfinite(metres) or metres <= 0:
        raise ValueError(f"'{METRES_PER_UNIT}' is {metres!r}, and must be a number above 0")
    return float(metres)
