# SPDX-License-Identifier: GPL-3.0-or-later
"""Random poses: they are inside the range of motion, each is reproducible, and the spread sets their distribution."""

import numpy as np
import pytest

from fdda_addon.core.mathematics.poses import (
    Channel,
    Overshoot,
    bones_with_changed_range,
    make_overshoot,
    sample_pose,
    widen_ranges,
)

CHANNELS = (
    Channel("a", "rotation", 0, -1.0, 3.0),
    Channel("a", "rotation", 2, 0.25, 0.5),
    Channel("b", "location", 1, -0.02, 0.0),
)
LOW, HIGH = np.array([[c.low, c.high] for c in CHANNELS]).T


def sample_poses(count: int, **options) -> np.ndarray:
    """Return (count, channels) values of the first random poses of seed 0."""
    return np.stack([sample_pose(CHANNELS, 0, index, **options) for index in range(count)])


@pytest.mark.parametrize("spread", [0.2, 1.0, 5.0])
def test_poses_stay_inside_the_range(spread):
    poses = sample_poses(500, spread=spread)
    assert (poses >= LOW).all() and (poses <= HIGH).all()


def test_poses_fill_the_range_symmetrically():
    poses = (sample_poses(4000) - LOW) / (HIGH - LOW)
    np.testing.assert_allclose(poses.mean(axis=0), 0.5, atol=0.02)
    assert (poses.min(axis=0) < 0.02).all() and (poses.max(axis=0) > 0.98).all()
    # A normal distribution truncated at its standard deviation has a standard deviation of 0.5396 times half the range.
    np.testing.assert_allclose(poses.std(axis=0), 0.5396 / 2, atol=0.01)


def test_spread_widens_the_distribution():
    deviations = [sample_poses(1500, spread=spread).std(axis=0) / (HIGH - LOW) for spread in (0.2, 1.0, 8.0)]
    # With spread 0.2 hardly anything is truncated; with spread 8 the distribution is nearly uniform.
    np.testing.assert_allclose(deviations[0], 0.1, atol=0.01)
    np.testing.assert_allclose(deviations[2], 12**-0.5, atol=0.015)
    assert (deviations[0] < deviations[1]).all() and (deviations[1] < deviations[2]).all()


def test_channels_are_independent():
    correlation = np.corrcoef(sample_poses(3000).T)
    assert np.abs(correlation - np.eye(3)).max() < 0.06


def test_a_pose_depends_only_on_seed_and_index():
    pose = sample_pose(CHANNELS, 7, 123)
    sample_pose(CHANNELS, 7, 5)
    assert np.array_equal(sample_pose(CHANNELS, 7, 123), pose)
    assert not np.array_equal(sample_pose(CHANNELS, 7, 124), pose)
    assert not np.array_equal(sample_pose(CHANNELS, 8, 123), pose)


def test_a_seed_gives_the_same_poses_in_every_version():
    """Resuming a recording with another version of the add-on needs the same poses of a seed."""
    np.testing.assert_allclose(
        sample_pose(CHANNELS, 0, 0), [1.2514604421867865, 0.35848689208858725, -0.0035957734955671793], rtol=1e-12
    )


def test_a_range_without_width_gives_its_only_value():
    assert sample_pose((Channel("a", "rotation", 0, 0.3, 0.3),), 0, 0).tolist() == [0.3]


def test_ranges_are_widened_about_their_middles():
    widened = widen_ranges(CHANNELS, 2.5)
    bounds = [(c.low, c.high) for c in widened]
    np.testing.assert_allclose(bounds, [(-4, 6), (0.0625, 0.6875), (-0.035, 0.015)], atol=1e-12)
    assert [(c.name, c.kind, c.axis) for c in widened] == [(c.name, c.kind, c.axis) for c in CHANNELS]


def test_range_changes_name_the_bones():
    assert bones_with_changed_range(CHANNELS, CHANNELS[::-1]) == []
    rounded_channels = (Channel("a", "rotation", 0, -1.0 + 5e-5, 3.0), *CHANNELS[1:])
    assert bones_with_changed_range(CHANNELS, rounded_channels) == []
    wider_channels = (Channel("a", "rotation", 0, -1.0, 3.1), *CHANNELS[1:])
    assert bones_with_changed_range(CHANNELS, wider_channels) == ["a"]
    assert bones_with_changed_range(CHANNELS, (CHANNELS[0], CHANNELS[2])) == ["a"]
    other_channels = (*CHANNELS[:2], Channel("c", "location", 1, -0.02, 0.0))
    assert bones_with_changed_range(CHANNELS, other_channels) == ["c", "b"]


def test_an_overshoot_widens_ranges_about_their_middles_and_unlocks_axes():
    locked_channels = (Channel("a", "rotation", 1, 0.0, 0.0),)
    other_channels = (Channel("b", "scale", 0, 0.5, 1.5), Channel("shape_keys/x", "control", 0, 0.0, 1.0))
    overshoot = make_overshoot((*CHANNELS, *other_channels), locked_channels, 3.0, 100)
    assert (overshoot.factor, overshoot.poses) == (3.0, 25)
    bounds = [(c.name, c.kind, c.axis, round(c.low, 6), round(c.high, 6)) for c in overshoot.channels]
    assert bounds == [
        ("a", "rotation", 0, -5.0, 7.0),
        ("a", "rotation", 2, 0.0, 0.75),
        ("b", "location", 1, -0.04, 0.02),
        ("b", "scale", 0, round(0.5 / 3, 6), 2.5),
        ("shape_keys/x", "control", 0, 0.0, 1.0),
        ("a", "rotation", 1, round(-np.pi / 2, 6), round(np.pi / 2, 6)),
    ]
    assert Overshoot.from_json(overshoot.to_json()) == overshoot


def test_a_factor_of_one_or_no_poses_give_no_overshoot():
    assert make_overshoot(CHANNELS, (), 1.0, 100) is None
    assert make_overshoot((), (), 2.0, 0) is None
