# SPDX-License-Identifier: GPL-3.0-or-later
"""Errors between two deformations of one mesh, and the colors of the heat map."""

from dataclasses import asdict, dataclass

import numpy as np

NO_ERROR_METRES = 1e-6
"""Below this error the heat map is green."""
HEAT_MAP_STOPS = ((NO_ERROR_METRES, (0.10, 0.25, 0.95)), (0.005, (0.60, 0.10, 0.80)), (0.01, (0.95, 0.05, 0.05)))
"""Error in meters and sRGB color: blue just above no error, violet at 0.5 cm, red at 1 cm and above."""
NO_ERROR_COLOR = (0.10, 0.70, 0.20)


@dataclass(frozen=True)
class ErrorStatistics:
    """Statistics of distances over vertices and poses, in millimeters."""

    mean: float
    rms: float
    p99: float
    p999: float
    max: float

    def to_json(self) -> dict:
        return asdict(self)


def distances(first: np.ndarray, second: np.ndarray, metres_per_unit: float = 1.0) -> np.ndarray:
    """Compute the distance of each vertex.

    Args:
        first, second: (N, V, 3) positions in the same space, mesh units.
        metres_per_unit: length of a mesh unit.

    Returns:
        (N, V) float32, meters.
    """
    return np.linalg.norm(first - second, axis=-1) * metres_per_unit


def error_statistics(errors: np.ndarray) -> ErrorStatistics:
    """Compute statistics of errors.

    Args:
        errors: distances in meters, any shape, not empty.
    """
    mm = np.asarray(errors, np.float64).ravel() * 1000
    p99, p999 = np.percentile(mm, (99, 99.9))
    return ErrorStatistics(float(mm.mean()), float(np.sqrt((mm**2).mean())), float(p99), float(p999), float(mm.max()))


def heat_colors(errors: np.ndarray, max_error: float = HEAT_MAP_STOPS[-1][0]) -> np.ndarray:
    """Compute the heat map colors of errors.

    Args:
        errors: (V,) meters.
        max_error: meters; this error and larger ones are red.

    Returns:
        (V, 3) float32 sRGB, 0 to 1: green below 1e-4 cm, then from blue through violet (half of `max_error`) to red.
    """
    stops = [stop * max_error / HEAT_MAP_STOPS[-1][0] for stop, _ in HEAT_MAP_STOPS]
    colors = np.array([color for _, color in HEAT_MAP_STOPS])
    heat = np.stack([np.interp(errors, stops, colors[:, channel]) for channel in range(3)], axis=-1)
    heat[np.asarray(errors) < NO_ERROR_METRES] = NO_ERROR_COLOR
    return heat.astype(np.float32)


def worst_poses(errors: np.ndarray, count: int, min_index_distance: int) -> list[int]:
    """Find the poses with the largest error of a vertex, the worst first.

    Args:
        errors: (N, V) meters.
        count: most poses to return.
        min_index_distance: smallest difference of two indices, so that one movement is not reported several times.

    Returns:
        Indices of poses; poses without error are left out.
    """
    largest = np.asarray(errors).max(axis=1)
    chosen: list[int] = []
    for index in np.argsort(-largest, kind="stable"):
        if len(chosen) == count or largest[index] < NO_ERROR_METRES:
            break
        if all(abs(int(index) - other) >= min_index_distance for other in chosen):
            chosen.append(int(index))
    return chosen
