# SPDX-License-Identifier: GPL-3.0-or-later
"""The check of jumps between similar poses: it reports jumps, and nothing in recordings without them."""

import re

import numpy as np
import pytest

from fdda_addon.core.checks.flips import find_similar_poses
from fdda_addon.core.recording.skinned import SkinnedRecording

from ..good_recording import (
    BONE_LENGTH,
    JOINTS,
    ROTATION_LIMIT,
    good_recording,
    single_warning_text,
    warning_texts,
    with_partitions,
)


def flipping_recording(pose_count: int, half_rotations: float, jump_metres: float, seed: int = 0) -> SkinnedRecording:
    """Return the tube with a lower joint that rotates by up to `half_rotations` times 180 degrees.

    Past 180 degrees the residuals near the joint jump by `jump_metres`.
    """
    angles = np.random.default_rng(seed).uniform(-ROTATION_LIMIT, ROTATION_LIMIT, (pose_count, len(JOINTS)))
    angles[:, 2] *= half_rotations * np.pi / ROTATION_LIMIT
    recording = good_recording(angles=angles)
    # Past 180 degrees, the shorter rotation to the same orientation has the opposite sign.
    wrapped_angles = np.mod(angles[:, 2] + np.pi, 2 * np.pi) - np.pi
    falloff = np.exp(-(((recording.rig.rest_positions[:, 2] / BONE_LENGTH - 2) / 0.4) ** 2))
    recording.residuals[:, :, 0] += jump_metres * (wrapped_angles / (2 * np.pi))[:, None] * falloff
    return recording


@pytest.mark.parametrize("poses", [100, 300, 1500])
def test_a_flipping_joint_is_reported(poses):
    text = single_warning_text(flipping_recording(poses, 1.1, 0.08), "flips")
    assert re.match(
        r"Vertices of '(upper|lower)' jump up to \d\d mm between similar poses, 'lower' on the two sides of 180 "
        r"degrees \(\d+ pairs?, such as poses \d+ and \d+\); [12] more partitions? jumps? too, and no network can "
        "learn a jump: keep its rotation below 180 degrees",
        text,
    )


def test_the_reported_poses_are_similar_and_far_apart_in_residuals():
    recording = flipping_recording(1500, 1.1, 0.08)
    a, b = map(int, re.search(r"poses (\d+) and (\d+)\)", single_warning_text(recording, "flips")).groups())
    residual_changes = np.linalg.norm(recording.residuals[a] - recording.residuals[b], axis=1)
    assert residual_changes.max() > 0.06
    # The lower joint has nearly the same orientation in both poses, on the two sides of the jump.
    lower_rotations = [np.linalg.inv(recording.pose_matrices[p, 1]) @ recording.pose_matrices[p, 2] for p in (a, b)]
    assert np.abs(lower_rotations[0] - lower_rotations[1]).max() < 0.3


@pytest.mark.parametrize(("half_rotations", "jump_metres"), [(0.95, 0.08), (1.1, 0.0), (0.5, 0.3), (1.1, 0.0005)])
def test_smooth_and_tiny_changes_are_no_flips(half_rotations, jump_metres):
    for seed in range(3):
        assert "flips" not in warning_texts(flipping_recording(400, half_rotations, jump_metres, seed))


def test_a_fast_change_by_another_joint_is_no_flip():
    """The hand drives a shape in a tenth of the poses, fast but without a jump, while the lower joint rotates."""
    for seed in range(3):
        angles = np.random.default_rng(seed).uniform(-ROTATION_LIMIT, ROTATION_LIMIT, (400, len(JOINTS)))
        recording = flipping_recording(400, 1.1, 0.0, seed)
        shape_values = np.clip((angles[:, 3] - 0.6) / 0.2, 0, 1)
        recording.residuals[:, :, 2] += 0.06 * shape_values[:, None]
        recording = with_partitions(recording, influencing=(1, 2, 3))
        assert "flips" not in warning_texts(recording)


@pytest.fixture
def dense_recording() -> SkinnedRecording:
    """A recording of 1,000 poses, so that each pose has neighbors in all inputs of its partition."""
    return good_recording(1000)


def test_a_switching_control_is_reported(dense_recording):
    falloff = np.exp(-((dense_recording.rig.rest_positions[:, 2] / BONE_LENGTH - 1.5) ** 2))
    dense_recording.residuals[:, :, 1] += 0.05 * (dense_recording.controls > 0.6) * falloff
    text = single_warning_text(dense_recording, "flips")
    assert re.search(r"jump up to \d\d mm between similar poses \(\d+ pairs, such as poses \d+ and \d+\)", text)
    assert "a jump: look for what switches there, a driver or a Shrinkwrap" in text


def test_a_jump_far_from_180_degrees_is_reported(dense_recording):
    """A Shrinkwrap modifier jumps like this where its nearest point changes to another part of the target."""
    local_rotations = np.linalg.inv(dense_recording.pose_matrices[:, 1]) @ dense_recording.pose_matrices[:, 2]
    vertices = dense_recording.partitions[1].vertices
    dense_recording.residuals[:, vertices, 2] += np.where(local_rotations[:, 2, 1] > 0.3, 0.04, 0.0)[:, None].astype(
        np.float32
    )
    text = single_warning_text(dense_recording, "flips")
    assert text.startswith("Vertices of 'upper' jump up to 4") and "180" not in text
    # The same change, spread over a fifth of the range, is no jump.
    smooth_values = np.clip((local_rotations[:, 2, 1] - 0.2) / 0.3, 0, 1)
    dense_recording.residuals[:, vertices, 2] += 0.04 * (smooth_values - (local_rotations[:, 2, 1] > 0.3))[:, None]
    assert warning_texts(dense_recording) == {}


def test_similar_poses_are_near_each_other():
    inputs = np.random.default_rng(0).uniform(0, 1, (300, 1))
    pairs = find_similar_poses(inputs, 0.2)
    assert len(pairs) > 300 and (pairs[:, 0] < pairs[:, 1]).all()
    assert np.abs(inputs[pairs[:, 0]] - inputs[pairs[:, 1]]).max() < 0.2 * 0.3
    assert len(find_similar_poses(np.ones((300, 4)), 0.2)) == 0


def test_equal_poses_are_not_paired():
    inputs = np.repeat(np.random.default_rng(0).uniform(0, 1, (100, 1)), 3, axis=0)
    pairs = find_similar_poses(inputs, 0.2)
    assert len(pairs) and (inputs[pairs[:, 0]] != inputs[pairs[:, 1]]).all()
