# SPDX-License-Identifier: GPL-3.0-or-later
"""Rotation vectors of many quaternions, chosen without jumps.

A rotation has several rotation vectors. For each quaternion, the vector nearest to those of the other quaternions is
chosen, so that the range over all quaternions is narrow.
"""

import numpy as np

FULL_TURN = 2 * np.pi
MAX_ITERATIONS = 10
"""Largest number of iterations of the search for a range's center. It converges after a few iterations."""
MAX_CENTER_CANDIDATES = 8
"""Number of rotations tried as the center where a range is wider than 180 degrees."""
MIN_ANGLE_RADIANS = 1e-9
"""The axis of a rotation by a smaller angle is undefined."""


def rotation_vectors(quaternions: np.ndarray) -> np.ndarray:
    """Compute rotation vectors (axis times angle) without jumps between them.

    Args:
        quaternions: (F, 4), w first; they need not be normalized, and one of length 0 means no rotation.

    Returns:
        (F, 3) float64, radians, continuous past 180 degrees from the rest pose.
    """
    unit_quaternions = _normalize(quaternions)
    vectors = to_rotation_vectors(unit_quaternions)
    angles = np.linalg.norm(vectors, axis=1, keepdims=True)
    # The other vector of each rotation: about the opposite axis, by the remaining angle to a full turn.
    alternatives = np.where(
        angles > MIN_ANGLE_RADIANS, vectors * (1 - FULL_TURN / np.maximum(angles, MIN_ANGLE_RADIANS)), vectors
    )
    return _choose_narrow_range(
        np.stack([vectors, alternatives], axis=1), to_rotation_vectors(_mean_quaternion(unit_quaternions)[None])[0]
    )


def total_range_width(values: np.ndarray) -> float:
    """Return the sum of the three range widths of (F, 3) values."""
    return float(np.ptp(values, axis=0).sum())


def _choose_narrow_range(candidates: np.ndarray, mean_rotation: np.ndarray) -> np.ndarray:
    """Choose (F, 3) of (F, 2, 3) candidates with narrow ranges; ranges around the rest pose are preferred."""
    best_values = _choose_nearest(np.zeros(3), candidates)
    if np.ptp(best_values, axis=0).max() <= np.pi:
        return best_values
    centers = candidates[np.linspace(0, len(candidates) - 1, MAX_CENTER_CANDIDATES).astype(int), 0]
    for center in (mean_rotation, *centers):
        candidate_values = _choose_nearest(center, candidates)
        if total_range_width(candidate_values) < total_range_width(best_values) - MIN_ANGLE_RADIANS:
            best_values = candidate_values
    return best_values


def _choose_nearest(center: np.ndarray, candidates: np.ndarray) -> np.ndarray:
    """Choose the (F, 3) candidates nearest to the center of their range; the search starts at `center`."""
    best_values = None
    for _ in range(MAX_ITERATIONS):
        nearest = np.square(candidates - center).sum(axis=2).argmin(axis=1)
        values = candidates[np.arange(len(candidates)), nearest]
        if best_values is not None and total_range_width(values) >= total_range_width(best_values) - MIN_ANGLE_RADIANS:
            break
        best_values, center = values, (values.min(axis=0) + values.max(axis=0)) / 2
    return best_values


def _normalize(quaternions: np.ndarray) -> np.ndarray:
    """Normalize (F, 4) quaternions; one of length 0 becomes the identity."""
    values = np.asarray(quaternions, np.float64)
    lengths = np.linalg.norm(values, axis=1, keepdims=True)
    return np.where(lengths > 0, values / np.where(lengths > 0, lengths, 1), (1.0, 0.0, 0.0, 0.0))


def _mean_quaternion(unit_quaternions: np.ndarray) -> np.ndarray:
    """Compute the mean rotation, (4,), independent of the signs of the quaternions.

    Source: Markley et al., Averaging Quaternions, 2007.
    """
    return np.linalg.eigh(unit_quaternions.T @ unit_quaternions)[1][:, -1]


def to_quaternions(vectors: np.ndarray) -> np.ndarray:
    """Compute (F, 4) unit quaternions, w first, from (F, 3) rotation vectors in radians."""
    half_angles = np.linalg.norm(vectors, axis=1, keepdims=True) / 2
    # numpy's sinc is sin(pi x) / (pi x), which is defined at 0.
    return np.hstack([np.cos(half_angles), vectors / 2 * np.sinc(half_angles / np.pi)])


def multiply_quaternions(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Multiply (F, 4) quaternions, w first: the rotation `second` in the space that `first` has rotated."""
    scalar, vector = first[:, :1], first[:, 1:]
    other_scalar, other_vector = second[:, :1], second[:, 1:]
    return np.hstack(
        [
            scalar * other_scalar - (vector * other_vector).sum(axis=1, keepdims=True),
            scalar * other_vector + other_scalar * vector + np.cross(vector, other_vector),
        ]
    )


def to_rotation_vectors(unit_quaternions: np.ndarray) -> np.ndarray:
    """Compute (F, 3) rotation vectors of at most 180 degrees, radians, from (F, 4) quaternions, w first."""
    unit_quaternions = np.where(unit_quaternions[:, :1] < 0, -unit_quaternions, unit_quaternions)
    sines = np.linalg.norm(unit_quaternions[:, 1:], axis=1, keepdims=True)
    angles = 2 * np.arctan2(sines, unit_quaternions[:, :1])
    return unit_quaternions[:, 1:] * np.where(
        sines > MIN_ANGLE_RADIANS, angles / np.maximum(sines, MIN_ANGLE_RADIANS), 2.0
    )
