# SPDX-License-Identifier: GPL-3.0-or-later
"""The choice of additional poses where a model is worst."""

import numpy as np
import pytest

from fdda_addon.core.mathematics.poses import Channel
from fdda_addon.core.mathematics.refinement import Probes, choose_poses, nearest_recorded_distances

CHANNELS = (
    Channel("a", "rotation", 0, -1, 1),
    Channel("a", "rotation", 1, 0, 0.5),
    Channel("b", "rotation", 0, -2, 0),
    Channel("c", "location", 2, -0.1, 0.1),
)
PARTITION_CHANNELS = [np.array([0, 1]), np.array([1, 2]), np.array([3]), np.array([], int)]
LOW, HIGH = (np.array([getattr(c, end) for c in CHANNELS]) for end in ("low", "high"))


def draw_values(count: int, seed: int = 0) -> np.ndarray:
    """Return (count, channels) random values within the ranges of `CHANNELS`."""
    return np.random.default_rng(seed).uniform(LOW, HIGH, (count, len(CHANNELS)))


def choose_values(errors: np.ndarray, distances: np.ndarray, values: np.ndarray, count: int = 400) -> np.ndarray:
    probes = Probes(values, errors, distances)
    return choose_poses(probes, CHANNELS, PARTITION_CHANNELS, draw_values(count, 9), np.random.default_rng(3))


def test_poses_are_in_range_and_repeatable():
    values, rng = draw_values(50), np.random.default_rng(1)
    errors, distances = rng.uniform(size=(2, 50, 4))
    poses = choose_values(errors, distances, values)
    assert (poses >= LOW).all() and (poses <= HIGH).all() and len(poses) == 400
    assert np.array_equal(poses, choose_values(errors, distances, values))


def test_poses_are_near_the_largest_error_and_the_largest_distance():
    values = draw_values(50)
    values[7], values[8] = (-0.6, 0.1, -1.5, 0.05), (0.6, 0.4, -0.5, -0.05)
    errors, distances = np.full((2, 50, 4), 1e-6)
    errors[7, 0] = distances[8, 0] = 0.01
    poses = choose_values(errors, distances, values)
    # Partition 0 has by far the largest error and chooses first: two thirds of the poses by error, a third
    # by distance.
    is_near_largest_error = np.abs(poses[:, 0] + 0.6) < 0.4
    is_near_largest_distance = np.abs(poses[:, 0] - 0.6) < 0.4
    assert is_near_largest_error.mean() == pytest.approx(
        2 / 3, abs=0.08
    ) and is_near_largest_distance.mean() == pytest.approx(1 / 3, abs=0.08)
    # Partition 1 shares a channel with partition 0 and must not change these poses; channel 2 keeps its random values.
    assert np.array_equal(poses[:, 2], draw_values(400, 9)[:, 2])


def test_nearest_distances_are_relative_to_standard_deviations():
    recorded = np.array([[0.0, 0, 5], [2, 0, 5], [2, 20, 5], [0, 20, 5]])
    distances = nearest_recorded_distances(np.array([[1.0, 0, 5], [2, 20, 5], [0, -10, 9]]), recorded)
    # The standard deviations are 1 and 10; the third feature does not vary and is ignored.
    assert distances == pytest.approx([1, 0, 1])
    assert nearest_recorded_distances(np.zeros((3, 1)), np.zeros((4, 1))).tolist() == [0, 0, 0]
