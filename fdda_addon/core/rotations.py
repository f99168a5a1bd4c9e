# SPDX-License-Identifier: GPL-3.0-or-later
"""Rotation vectors and Euler angles of many quaternions, chosen without jumps.

A rotation has several rotation vectors and several triples of Euler angles. For each quaternion the triple nearest to
the others is chosen, so that the range over all of them is narrow.
"""

import numpy as np

FULL_TURN = 2 * np.pi
MAX_ITERATIONS = 10
"""Limit for the search of a range's center, which converges after a few iterations."""
MAX_CENTER_CANDIDATES = 8
"""Number of rotations tried as the center where a range is wider than 180 degrees."""
GIMBAL_LOCK_TOLERANCE = 1e-12
"""Euler angles are in gimbal lock where the sine of the middle angle is within this of 1."""
MIN_ANGLE_RADIANS = 1e-9
"""A rotation by a smaller angle has no axis."""


def rotation_vectors(quaternions: np.ndarray) -> np.ndarray:
    """Compute rotation vectors (axis times angle) without jumps between them.

    Args:
        quaternions: (F, 4), w first, of any length; length 0 means no rotation.

    Returns:
        (F, 3) float64, radians, continuous past 180 degrees from the rest pose.
    """
    unit = _normalized(quaternions)
    vectors = _logarithm(unit)
    angles = np.linalg.norm(vectors, axis=1, keepdims=True)
    # The same rotation in the opposite direction.
    others = np.where(
        angles > MIN_ANGLE_RADIANS, vectors * (1 - FULL_TURN / np.maximum(angles, MIN_ANGLE_RADIANS)), vectors
    )
    return _nearest(np.stack([vectors, others], axis=1), _logarithm(_mean(unit)[None])[0])


def euler_angles(quaternions: np.ndarray) -> np.ndarray:
    """Compute XYZ Euler angles without jumps between them.

    Args:
        quaternions: as for `rotation_vectors`.

    Returns:
        (F, 3) float64, radians.
    """
    unit = _normalized(quaternions)
    angles = _xyz(unit)
    others = angles * (1, -1, 1) + np.pi
    return _nearest(np.stack([angles, others], axis=1), _xyz(_mean(unit)[None])[0], FULL_TURN)


def total_range_width(values: np.ndarray) -> float:
    """Return the sum of the three range widths of (F, 3) values."""
    return float(np.ptp(values, axis=0).sum())


def _nearest(candidates: np.ndarray, mean: np.ndarray, period: float = 0.0) -> np.ndarray:
    """Choose (F, 3) of (F, 2, 3) candidates so that their ranges are narrow, around the rest pose where possible."""
    best = _nearest_to(np.zeros(3), candidates, period)
    if np.ptp(best, axis=0).max() <= np.pi:
        return best
    centers = candidates[np.linspace(0, len(candidates) - 1, MAX_CENTER_CANDIDATES).astype(int), 0]
    for center in (mean, *centers):
        values = _nearest_to(center, candidates, period)
        if total_range_width(values) < total_range_width(best) - MIN_ANGLE_RADIANS:
            best = values
    return best


def _nearest_to(center: np.ndarray, candidates: np.ndarray, period: float) -> np.ndarray:
    """Choose the (F, 3) candidates nearest to the center of their range; the search starts at `center`."""
    best = None
    for _ in range(MAX_ITERATIONS):
        shifted = candidates - period * np.round((candidates - center) / period) if period else candidates
        nearest = np.square(shifted - center).sum(axis=2).argmin(axis=1)
        values = shifted[np.arange(len(shifted)), nearest]
        if best is not None and total_range_width(values) >= total_range_width(best) - MIN_ANGLE_RADIANS:
            break
        best, center = values, (values.min(axis=0) + values.max(axis=0)) / 2
    return best


def _normalized(quaternions: np.ndarray) -> np.ndarray:
    values = np.asarray(quaternions, np.float64)
    lengths = np.linalg.norm(values, axis=1, keepdims=True)
    return np.where(lengths > 0, values / np.where(lengths > 0, lengths, 1), (1.0, 0.0, 0.0, 0.0))


def _mean(unit: np.ndarray) -> np.ndarray:
    """Compute the mean rotation, (4,), independent of the signs of the quaternions.

    Source: Markley et al., Averaging Quaternions, 2007.
    """
    return np.linalg.eigh(unit.T @ unit)[1][:, -1]


def _logarithm(unit: np.ndarray) -> np.ndarray:
    """Compute (F, 3) rotation vectors of at most 180 degrees."""
    unit = np.where(unit[:, :1] < 0, -unit, unit)
    sines = np.linalg.norm(unit[:, 1:], axis=1, keepdims=True)
    angles = 2 * np.arctan2(sines, unit[:, :1])
    return unit[:, 1:] * np.where(sines > MIN_ANGLE_RADIANS, angles / np.maximum(sines, MIN_ANGLE_RADIANS), 2.0)


def _xyz(unit: np.ndarray) -> np.ndarray:
    """Compute (F, 3) XYZ Euler angles, the middle one within 90 degrees."""
    w, x, y, z = unit.T
    sine = np.clip(2 * (y * w - x * z), -1, 1)
    first = np.arctan2(2 * (y * z + x * w), 1 - 2 * (x * x + y * y))
    last = np.arctan2(2 * (x * y + z * w), 1 - 2 * (y * y + z * z))
    # In gimbal lock the first and the last angle have the same axis.
    is_locked = np.abs(sine) > 1 - GIMBAL_LOCK_TOLERANCE
    return np.stack(
        [np.where(is_locked, 2 * np.arctan2(x, w), first), np.arcsin(sine), np.where(is_locked, 0, last)], 1
    )
