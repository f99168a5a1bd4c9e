# SPDX-License-Identifier: GPL-3.0-or-later
"""Errors between two deformations of one mesh, and the colors of the heat map."""

from dataclasses import asdict, dataclass, fields

import numpy as np

NO_ERROR_METRES = 1e-6
"""Smaller errors are green in the heat map."""
HEAT_MAP_STOPS = ((NO_ERROR_METRES, (0.10, 0.25, 0.95)), (0.005, (0.60, 0.10, 0.80)), (0.01, (0.95, 0.05, 0.05)))
"""Error in meters and sRGB color: blue just above no error, violet at 0.5 cm, red at 1 cm and above."""
NO_ERROR_COLOR = (0.10, 0.70, 0.20)
VIEWPORT_STOPS = (
    (0.0, (0.00, 0.00, 1.00)),
    (0.25, (0.00, 1.00, 1.00)),
    (0.5, (0.00, 1.00, 0.00)),
    (0.75, (1.00, 1.00, 0.00)),
    (1.0, (1.00, 0.00, 0.00)),
)
"""Ratio of the largest shown error and sRGB color in the viewport: the colors of Blender's Weight Paint mode."""


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

    @staticmethod
    def from_json(value: dict) -> "ErrorStatistics":
        """Read the JSON of `to_json`, which may have further keys."""
        return ErrorStatistics(*(value[field.name] for field in fields(ErrorStatistics)))


def distances(first: np.ndarray, second: np.ndarray, metres_per_unit: float = 1.0) -> np.ndarray:
    """Compute the distance of each vertex between two deformations.

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
    millimeters = np.asarray(errors, np.float64).ravel() * 1000
    percentiles = np.percentile(millimeters, (99, 99.9))
    values = (millimeters.mean(), np.sqrt((millimeters**2).mean()), *percentiles, millimeters.max())
    return ErrorStatistics(*map(float, values))


def heat_colors(errors: np.ndarray, max_error: float = HEAT_MAP_STOPS[-1][0]) -> np.ndarray:
    """Compute the heat map colors of errors in pictures.

    Args:
        errors: (V,) meters.
        max_error: meters; this error and larger ones are red.

    Returns:
        (V, 3) float32 sRGB, 0 to 1: green below 1e-4 cm, then from blue through violet (half of `max_error`) to red.
    """
    vertex_colors = _interpolate_colors(np.asarray(errors) * (HEAT_MAP_STOPS[-1][0] / max_error), HEAT_MAP_STOPS)
    vertex_colors[np.asarray(errors) < NO_ERROR_METRES] = NO_ERROR_COLOR
    return vertex_colors


def viewport_colors(errors: np.ndarray, max_error: float) -> np.ndarray:
    """Compute the colors of errors in the viewport.

    Args:
        errors: (V,) meters.
        max_error: meters; this error and larger ones are red.

    Returns:
        (V, 3) float32 sRGB, 0 to 1: blue without error, then cyan, green, yellow and red (`VIEWPORT_STOPS`).
    """
    return _interpolate_colors(np.asarray(errors) / max_error, VIEWPORT_STOPS)


def _interpolate_colors(values: np.ndarray, stops: tuple[tuple[float, tuple[float, float, float]], ...]) -> np.ndarray:
    positions, colors = zip(*stops, strict=True)
    channels = [np.interp(values, positions, channel) for channel in zip(*colors, strict=True)]
    return np.stack(channels, axis=-1).astype(np.float32)


def worst_poses(errors: np.ndarray, count: int, min_index_distance: int) -> list[int]:
    """Find the poses with the largest errors of a vertex, in descending order of error.

    Args:
        errors: (N, V) meters.
        count: largest number of poses to return.
        min_index_distance: smallest difference of two indices, so that one movement is not reported several times.

    Returns:
        Indices of poses; poses without error are left out.
    """
    pose_errors = np.asarray(errors).max(axis=1)
    chosen: list[int] = []
    for index in np.argsort(-pose_errors, kind="stable"):
        if len(chosen) == count or pose_errors[index] < NO_ERROR_METRES:
            break
        if all(abs(int(index) - chosen_index) >= min_index_distance for chosen_index in chosen):
            chosen.append(int(index))
    return chosen
