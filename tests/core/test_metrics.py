# SPDX-License-Identifier: GPL-3.0-or-later
"""Error statistics in mm, and the colors of heat maps."""

import numpy as np
import pytest

from fdda_addon.core.metrics import NO_ERROR_COLOR, distances, error_statistics, heat_colors, worst_poses


def test_distances_are_of_vertices():
    first = np.zeros((2, 3, 3), np.float32)
    second = first.copy()
    second[1, 2] = (0.003, 0, 0.004)
    assert distances(first, second) == pytest.approx(np.array([[0, 0, 0], [0, 0, 0.005]]))


def test_statistics_are_in_millimetres():
    errors = np.linspace(0, 0.010, 10_001).reshape(73, 137)
    found = error_statistics(errors)
    assert found.mean == pytest.approx(5.0)
    assert found.rms == pytest.approx(10 / 3**0.5, rel=1e-3)
    assert (found.p99, found.p999, found.max) == pytest.approx((9.9, 9.99, 10.0))
    assert list(found.to_json()) == ["mean", "rms", "p99", "p999", "max"]


def test_percentiles_of_one_large_error_among_many():
    errors = np.zeros(1000)
    errors[17] = 0.04
    found = error_statistics(errors)
    assert (found.mean, found.rms, found.max) == pytest.approx((0.04, 40 * 1000**-0.5, 40.0))
    assert found.p99 == 0
    assert found.p999 == pytest.approx(0.04)  # interpolated between the last two


def test_statistics_survive_float32_sums():
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
    found = heat_colors(np.array([error]))
    assert found.shape == (1, 3) and found.dtype == np.float32
    np.testing.assert_allclose(found[0], color, atol=1e-5)


def test_heat_none_is_green_and_the_other_stops_are_what_they_are_called():
    green, blue, violet, red = heat_colors(np.array([0, 1e-6, 0.005, 0.01]))
    assert green.argmax() == 1 and blue.argmax() == 2 and red.argmax() == 0
    assert violet[1] < violet[0] < violet[2]


def test_more_error_is_more_red():
    reds = heat_colors(np.linspace(1e-6, 0.01, 50))[:, 0]
    assert (np.diff(reds) > 0).all()


def test_a_narrower_range_moves_the_colors_and_not_what_counts_as_none():
    np.testing.assert_allclose(heat_colors(np.array([0.0005, 0.001]), 0.001), [VIOLET, RED], atol=1e-5)
    assert np.array_equal(heat_colors(np.array([0.5e-6]), 0.001)[0], np.float32(NO_ERROR_COLOR))


def test_worst_poses_are_apart_and_in_order():
    errors = np.zeros((12, 3))
    errors[[2, 3, 7, 11], [0, 1, 2, 0]] = 0.01, 0.03, 0.02, 1e-9
    assert worst_poses(errors, 5, 2) == [3, 7]
    assert worst_poses(errors, 5, 1) == [3, 7, 2]
    assert worst_poses(errors, 1, 1) == [3]
    assert worst_poses(np.zeros((4, 2)), 3, 1) == []
