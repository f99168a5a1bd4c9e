# SPDX-License-Identifier: GPL-3.0-or-later
"""Random poses, remixed poses, and poses that a refinement adds."""

from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.mathematics.poses import (
    CONTROL,
    LOCATION,
    ROTATION,
    ROTATION_VECTOR,
    SCALE,
    Channel,
    Overshoot,
    bones_with_changed_range,
    make_overshoot,
    sample_pose,
    widen_ranges,
)
from fdda_addon.core.mathematics.refinement import Probes, choose_poses, nearest_recorded_distances
from fdda_addon.core.mathematics.remix import PoseSampler, Remix, find_limbs, replace_bone_channels
from fdda_addon.core.mathematics.rotations import (
    multiply_quaternions,
    rotation_vectors,
    to_quaternions,
    to_rotation_vectors,
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


def test_a_seed_gives_the_same_poses_in_every_version():
    """Resuming a recording with another version of the add-on needs the same poses of a seed."""
    np.testing.assert_allclose(
        sample_pose(CHANNELS, 0, 0), [1.2514604421867865, 0.35848689208858725, -0.0035957734955671793], rtol=1e-12
    )


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


FRAMES = 50


@pytest.mark.parametrize(
    ("parents", "limbs"),
    [
        ([], []),
        ([-1], [0]),
        ([-1, 0, 1], [0, 0, 0]),
        # Hips with a spine and two legs of two bones each.
        ([-1, 0, 1, 0, 3, 0, 5], [0, 1, 1, 2, 2, 3, 3]),
        # A hand with two fingers continues the arm; the fingers are limbs.
        ([-1, 0, 1, 1, 2], [0, 0, 1, 2, 1]),
        ([-1, -1, 1], [0, 1, 1]),
    ],
)
def test_limbs_are_chains_from_a_root_or_a_branching_bone(parents, limbs):
    assert find_limbs(parents).tolist() == limbs


def make_remix() -> Remix:
    """Two bones with a limb each; the second has a location and a locked axis. Each value identifies its frame."""
    channels = [Channel(name, ROTATION_VECTOR, axis, -1.0, 1.0) for name in "ab" for axis in range(3)]
    channels.append(Channel("b", LOCATION, 1, 0.0, 1.0))
    frames = np.arange(FRAMES)
    vectors = np.stack([np.cos(frames), np.sin(frames), frames / FRAMES], axis=1) * 0.8
    values = np.column_stack([vectors, vectors[::-1], frames])
    has_noise = np.array([True] * 3 + [True, False, True] + [False])
    return Remix(tuple(channels), values, np.array([0, 0, 0, 1, 1, 1, 1]), has_noise)


def test_a_limb_has_the_values_of_one_frame_and_the_limbs_are_independent():
    remix = make_remix()
    frames = []
    for index in range(300):
        pose = remix.draw_pose(3, index, 0.0)
        rows = [
            int(np.abs(remix.values[:, limb] - pose[limb]).max(axis=1).argmin()) for limb in ([0, 1, 2], [3, 4, 5, 6])
        ]
        assert pose[:3] == pytest.approx(remix.values[rows[0], :3]) and pose[3:] == pytest.approx(
            remix.values[rows[1], 3:]
        )
        frames.append(rows)
    assert abs(np.corrcoef(np.array(frames).T)[0, 1]) < 0.2
    assert all(len(set(column)) > 40 for column in np.array(frames).T.tolist())


def test_noise_rotates_free_axes_of_the_bone_by_its_standard_deviation():
    """The noise is the rotation between a pose with and without noise, in the space of the bone."""
    remix = make_remix()
    noise = []
    for index in range(400):
        plain, noisy = (to_quaternions(remix.draw_pose(0, index, s)[:6].reshape(2, 3)) for s in (0.0, 0.1))
        noise.append(to_rotation_vectors(multiply_quaternions(plain * (1, -1, -1, -1), noisy)))
    deviations = np.std(noise, axis=0)
    assert deviations[0] == pytest.approx([0.1] * 3, rel=0.15)
    assert deviations[1, [0, 2]] == pytest.approx([0.1] * 2, rel=0.15) and deviations[1, 1] < 1e-9


def test_every_second_pose_is_drawn_from_the_ranges():
    remix = make_remix()
    channels = (*remix.channels, Channel("c", ROTATION, 0, -1.0, 1.0))
    sampler = PoseSampler(5, 0.5, remix)
    assert np.array_equal(sampler.draw_pose(channels, 3), sample_pose(channels, 5, 3, 0.5))
    values = sampler.draw_pose(channels, 4)
    assert np.array_equal(values[:-1], remix.draw_pose(5, 4)) and values[-1] == sample_pose(channels, 5, 4, 0.5)[-1]
    assert np.array_equal(PoseSampler(5, 0.5).draw_pose(channels, 4), sample_pose(channels, 5, 4, 0.5))


def test_keys_rest_in_a_part_of_the_plain_poses():
    """From none to all keys move in a pose; those that do have the values of `sample_pose`."""
    keys = [Channel(f"key {number}", CONTROL, 0, -0.5, 1.0, True) for number in range(30)]
    # The locked axis of a bone rests with the others.
    lid = [Channel("lid", LOCATION, 0, -0.1, 0.1, True), Channel("lid", SCALE, 0, 0.5, 1.5)]
    channels = (*keys, *lid, Channel("jaw", ROTATION, 0, -1.0, 1.0))
    no_keys = tuple(replace(channel, is_key=False) for channel in channels)
    poses, plain = (
        np.stack([sample_pose(drawn_channels, 3, index) for index in range(300)])
        for drawn_channels in (channels, no_keys)
    )
    moves = poses == plain
    assert np.array_equal(poses[~moves], np.broadcast_to([c.rest for c in channels], poses.shape)[~moves])
    assert moves[:, -1].all() and np.array_equal(moves[:, -3], moves[:, -2])
    counts = moves[:, :30].sum(axis=1)
    assert counts.min() == 0 and counts.max() == 30 and counts.mean() == pytest.approx(15, rel=0.1)
    assert np.ptp(moves[:, :30].mean(axis=0)) < 0.15
    remix = make_remix()
    remixed_keys = tuple(replace(channel, is_key=True) for channel in remix.channels)
    assert np.array_equal(PoseSampler(5, 0.5, remix).draw_pose(remixed_keys, 4), remix.draw_pose(5, 4))
    alone = np.stack([sample_pose(tuple(keys[:2]), 3, index) for index in range(100)])
    assert (alone != 0).any(axis=1).all() and (alone == 0).any(), "a pose of keys alone moves one"


def test_the_channels_of_a_remixed_bone_are_replaced():
    remix = make_remix()
    other = Channel("c", ROTATION, 0, -1.0, 1.0)
    assert replace_bone_channels([Channel("a", ROTATION, 0, -1.0, 1.0), other], remix.channels) == (
        other,
        *remix.channels,
    )


def test_quaternions_and_rotation_vectors_are_inverse():
    vectors = np.random.default_rng(0).uniform(-1.7, 1.7, (100, 3))
    vectors[0] = 0
    assert to_rotation_vectors(to_quaternions(vectors)) == pytest.approx(vectors)
    assert rotation_vectors(to_quaternions(vectors)) == pytest.approx(vectors)


REFINED_CHANNELS = (
    Channel("a", "rotation", 0, -1, 1),
    Channel("a", "rotation", 1, 0, 0.5),
    Channel("b", "rotation", 0, -2, 0),
    Channel("c", "location", 2, -0.1, 0.1),
)

PARTITION_CHANNELS = [np.array([0, 1]), np.array([1, 2]), np.array([3]), np.array([], int)]

REFINED_LOW, REFINED_HIGH = (np.array([getattr(c, end) for c in REFINED_CHANNELS]) for end in ("low", "high"))


def draw_values(count: int, seed: int = 0) -> np.ndarray:
    """Return (count, channels) random values within the ranges of `REFINED_CHANNELS`."""
    return np.random.default_rng(seed).uniform(REFINED_LOW, REFINED_HIGH, (count, len(REFINED_CHANNELS)))


def choose_values(errors: np.ndarray, distances: np.ndarray, values: np.ndarray, count: int = 400) -> np.ndarray:
    probes = Probes(values, errors, distances)
    return choose_poses(probes, REFINED_CHANNELS, PARTITION_CHANNELS, draw_values(count, 9), np.random.default_rng(3))


def test_poses_are_in_range_and_repeatable():
    values, rng = draw_values(50), np.random.default_rng(1)
    errors, distances = rng.uniform(size=(2, 50, 4))
    poses = choose_values(errors, distances, values)
    assert (poses >= REFINED_LOW).all() and (poses <= REFINED_HIGH).all() and len(poses) == 400
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
