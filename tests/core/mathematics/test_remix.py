# SPDX-License-Identifier: GPL-3.0-or-later
"""Remixed poses: limbs from different frames, with noise, and the plain random poses between them."""

from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.mathematics.poses import CONTROL, LOCATION, ROTATION, ROTATION_VECTOR, SCALE, Channel, sample_pose
from fdda_addon.core.mathematics.remix import PoseSampler, Remix, find_limbs, replace_bone_channels
from fdda_addon.core.mathematics.rotations import (
    multiply_quaternions,
    rotation_vectors,
    to_quaternions,
    to_rotation_vectors,
)

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


def test_a_pose_depends_on_seed_and_index_alone():
    remix = make_remix()
    assert np.array_equal(remix.draw_pose(1, 7), remix.draw_pose(1, 7))
    assert not np.array_equal(remix.draw_pose(1, 7), remix.draw_pose(2, 7))
    assert not np.array_equal(remix.draw_pose(1, 7), remix.draw_pose(1, 8))


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
