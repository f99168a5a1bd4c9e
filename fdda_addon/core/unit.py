# SPDX-License-Identifier: GPL-3.0-or-later
"""The length of a unit of mesh-object space in recordings and models."""

import math

METRES_PER_UNIT = "metres_per_unit"
"""Key in `recording.json` and in a model's metadata; left out where a unit is one meter."""
UNIT_TOLERANCE = 1e-6
"""Largest difference in meters at which a unit counts as one meter."""


def unit_to_json(metres_per_unit: float) -> dict[str, float]:
    """Return the JSON entry of the unit; empty where a unit is one meter."""
    return {} if abs(metres_per_unit - 1) <= UNIT_TOLERANCE else {METRES_PER_UNIT: metres_per_unit}


def read_unit(value: dict) -> float:
    """Read the length of a unit in meters from the JSON of a file.

    Raises:
        ValueError: the entry is not a positive number.
    """
    meters = value.get(METRES_PER_UNIT, 1.0)
    if type(meters) not in (int, float) or not math.isfinite(meters) or meters <= 0:
        raise ValueError(f"'{METRES_PER_UNIT}' is {meters!r}, and must be a number above 0")
    return float(meters)
