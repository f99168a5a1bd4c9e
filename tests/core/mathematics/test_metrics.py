# SPDX-License-Identifier: GPL-3.0-or-later
"""Error statistics in millimeters, colors of heat maps, and the worst poses."""

import numpy as np
import pytest

from fdda_addon.core.mathematics.metrics import (
    NO_ERROR_COLOR,
    distances,
    error_statistics,
    heat_colors,
    viewport_colors,
    worst_poses,
)


def test_distances_are_computed_per_vertex():
    positions = np.zeros((2, 3, 3), np.float32)
    moved_positions = positions.copy()
    moved_positions[1, 2] = (0.003, 0, 0.004)
    assert distances(positions, moved_positions) == pytest.approx(np.array([[0, 0, 0], [0, 0, 0.005]]))


def test_statistics_are_in_millimeters():
    errors = np.linspace(0, 0.010, 10_001).reshape(73, 137)
    statistics = error_statistics(errors)
    assert statistics.mean == pytest.approx(5.0)
    assert statistics.rms == pytest.approx(10 / 3**0.5, rel=1e-3)
    assert (statistics.p99, statistics.p999, statistics.max) == pytest.approx((9.9, 9.99, 10.0))
    assert list(statistics.to_json()) == ["mean", "rms", "p99", "p999", "max"]


def test_statistics_of_float32_errors_are_exact():
    assert error_statistics(np.full(3_000_000, 1e-5, np.float32)).mean == pytest.approx(0.01, rel=1e-6)


BLUE, VIOLET, RED = (0.10, 0.25, 0.95), (0.60, 0.10, 0.80), (0.95, 0.05, 0.05)


@pytest.mark.parametrize(
    ("error", "color"),
    [
        (0.0, NO_ERROR_COLOR),
        (0.99e-6, NO_ERROR_COLOR),
        (1e-6, BLUE),
        (0.005, VIOLET),
        (0.0075, np.mean([VIOLET, RED], axis=0)),
        (0.010, RED),
        (3.0, RED),
    ],
)
def test_heat_colors_at_the_stops(error, color):
    computed_color = heat_colors(np.array([error]))
    assert computed_color.shape == (1, 3) and computed_color.dtype == np.float32
    np.testing.assert_allclose(computed_color[0], color, atol=1e-5)


def test_a_narrower_range_changes_colors_but_not_the_zero_threshold():
    np.testing.assert_allclose(heat_colors(np.array([0.0005, 0.001]), 0.001), [VIOLET, RED], atol=1e-5)
    assert np.array_equal(heat_colors(np.array([0.5e-6]), 0.001)[0], np.float32(NO_ERROR_COLOR))


def test_worst_poses_keep_a_distance_and_are_sorted():
    errors = np.zeros((12, 3))
    errors[[2, 3, 7, 11], [0, 1, 2, 0]] = 0.01, 0.03, 0.02, 1e-9
    assert worst_poses(errors, 5, 2) == [3, 7]
    assert worst_poses(errors, 5, 1) == [3, 7, 2]
    assert worst_poses(errors, 1, 1) == [3]
    assert worst_poses(np.zeros((4, 2)), 3, 1) == []


def test_viewport_colors_are_those_of_weight_paint():
    colors = viewport_colors(np.array([0.0, 0.0025, 0.005, 0.0075, 0.01, 1.0]), 0.01)
    blue, cyan, green, yellow, red = (0, 0, 1), (0, 1, 1), (0, 1, 0), (1, 1, 0), (1, 0, 0)
    np.testing.assert_allclose(colors, [blue, cyan, green, yellow, red, red], atol=1e-6)
    assert colors.dtype == np.float32
