# SPDX-License-Identifier: GPL-3.0-or-later
"""Jumps between similar poses: found where there are some, and nowhere else."""

import re

import numpy as np
import pytest

from fdda_addon.core.checks.flips import find_similar_poses
from fdda_addon.core.recording.reader import Recording

from .good_recording import BONE, JOINTS, LIMIT, good_recording, only, warned, with_partitions


def flipping(poses: int, reach: float, jump: float, seed: int = 0) -> Recording:
    """The tube, whose lower joint turns by up to `reach` times 180 degrees and jumps where it has passed 180."""
    angles = np.random.default_rng(seed).uniform(-LIMIT, LIMIT, (poses, len(JOINTS)))
    angles[:, 2] *= reach * np.pi / LIMIT
    recording = good_recording(angles=angles)
    # Beyond 180 degrees the rotation is one on the other side: from there on the shorter way is the other one.
    beyond = np.mod(angles[:, 2] + np.pi, 2 * np.pi) - np.pi
    near = np.exp(-(((recording.rig.rest_positions[:, 2] / BONE - 2) / 0.4) ** 2))
    recording.residuals[:, :, 0] += jump * (beyond / (2 * np.pi))[:, None] * near
    return recording


@pytest.mark.parametrize("poses", [100, 300, 1500])
def test_a_joint_that_flips(poses):
    text = only(flipping(poses, 1.1, 0.08), "flips")
    assert re.match(
        r"Vertices of '(upper|lower)' jump up to \d\d mm between similar poses, 'lower' on the two sides of 180 "
        r"degrees \(\d+ pairs?, such as poses \d+ and \d+\); [12] more partitions? jumps? too, and no network follows "
        "a jump: keep its rotation below 180 degrees",
        text,
    )


def test_the_poses_of_a_flip_are_those_that_jump():
    recording = flipping(1500, 1.1, 0.08)
    a, b = map(int, re.search(r"poses (\d+) and (\d+)\)", only(recording, "flips")).groups())
    apart = np.linalg.norm(recording.residuals[a] - recording.residuals[b], axis=1)
    assert apart.max() > 0.06
    # Alike: the lower joint stands nearly the same in both, on the two sides of the jump.
    local = [np.linalg.inv(recording.pose_matrices[p, 1]) @ recording.pose_matrices[p, 2] for p in (a, b)]
    assert np.abs(local[0] - local[1]).max() < 0.3


@pytest.mark.parametrize(("reach", "jump"), [(0.95, 0.08), (1.1, 0.0), (0.5, 0.3), (1.1, 0.0005)])
def test_what_is_no_flip(reach, jump):
    for seed in range(3):
        assert "flips" not in warned(flipping(400, reach, jump, seed))


def test_what_another_joint_does_in_few_poses_is_no_flip():
    """A shape that the hand drives in a tenth of the poses, fast but without a jump, while the lower joint turns."""
    for seed in range(3):
        angles = np.random.default_rng(seed).uniform(-LIMIT, LIMIT, (400, len(JOINTS)))
        recording = flipping(400, 1.1, 0.0, seed)
        driven = np.clip((angles[:, 3] - 0.6) / 0.2, 0, 1)
        recording.residuals[:, :, 2] += 0.06 * driven[:, None]
        recording = with_partitions(recording, influencing=(1, 2, 3))
        assert "flips" not in warned(recording)


@pytest.fixture
def many() -> Recording:
    """Enough poses for neighbors in all inputs: a joint or two, and a control."""
    return good_recording(1000)


def test_a_control_that_switches(many):
    near = np.exp(-((many.rig.rest_positions[:, 2] / BONE - 1.5) ** 2))
    many.residuals[:, :, 1] += 0.05 * (many.controls > 0.6) * near
    text = only(many, "flips")
    assert re.search(r"jump up to \d\d mm between similar poses \(\d+ pairs, such as poses \d+ and \d+\)", text)
    assert "a jump: look for what switches there, a driver or a Shrinkwrap" in text


def test_a_jump_far_from_a_half_turn(many):
    """As a Shrinkwrap jumps, whose nearest point becomes another."""
    local = np.linalg.inv(many.pose_matrices[:, 1]) @ many.pose_matrices[:, 2]
    vertices = many.partitions[1].vertices
    many.residuals[:, vertices, 2] += np.where(local[:, 2, 1] > 0.3, 0.04, 0.0)[:, None].astype(np.float32)
    text = only(many, "flips")
    assert text.startswith("Vertices of 'upper' jump up to 4") and "180" not in text
    # The same over a fifth of the range is no jump.
    smooth = np.clip((local[:, 2, 1] - 0.2) / 0.3, 0, 1)
    many.residuals[:, vertices, 2] += 0.04 * (smooth - (local[:, 2, 1] > 0.3))[:, None]
    assert warned(many) == {}


def test_alike_poses_are_near():
    values = np.random.default_rng(0).uniform(0, 1, (300, 1))
    pairs = find_similar_poses(values, 0.2)
    assert len(pairs) > 300 and (pairs[:, 0] < pairs[:, 1]).all()
    assert np.abs(values[pairs[:, 0]] - values[pairs[:, 1]]).max() < 0.2 * 0.3
    assert len(find_similar_poses(np.ones((300, 4)), 0.2)) == 0


def test_equal_poses_are_no_neighbors():
    values = np.repeat(np.random.default_rng(0).uniform(0, 1, (100, 1)), 3, axis=0)
    pairs = find_similar_poses(values, 0.2)
    assert len(pairs) and (values[pairs[:, 0]] != values[pairs[:, 1]]).all()
