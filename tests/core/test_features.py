# SPDX-License-Identifier: GPL-3.0-or-later
"""What networks see of a pose, against the formula."""

from dataclasses import replace

import numpy as np

from fdda_addon.core.features import joint_features, joint_features_in_metres

from .limb import JOINTS, make_rig, random_poses, random_transforms


def features_by_hand(pose: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """(J, 12): (B_p^-1 B_j)^-1 P_p^-1 P_j, joint by joint."""
    rows = []
    for number, joint in enumerate(JOINTS):
        parent_pose, parent_rest = (
            (np.eye(4), np.eye(4)) if joint.parent < 0 else (pose[joint.parent], rest[joint.parent])
        )
        rest_relative = np.linalg.inv(parent_rest) @ rest[number]
        rows.append((np.linalg.inv(rest_relative) @ np.linalg.inv(parent_pose) @ pose[number])[:3].reshape(12))
    return np.array(rows)


def test_rest_pose_is_the_identity():
    rig = make_rig()
    features = joint_features(rig.rest_matrices[None], rig.rest_matrices, rig.parents)
    assert features.shape == (1, len(JOINTS), 12) and features.dtype == np.float32
    np.testing.assert_allclose(features[0], np.tile(np.eye(4)[:3].reshape(12), (len(JOINTS), 1)), atol=1e-6)


def test_features_follow_the_formula():
    rig, poses = make_rig(), random_poses(8)
    features = joint_features(poses, rig.rest_matrices, rig.parents)
    for pose, found in zip(poses.astype(np.float64), features, strict=True):
        np.testing.assert_allclose(found, features_by_hand(pose, rig.rest_matrices.astype(np.float64)), atol=1e-5)


def test_moving_the_root_moves_the_features_of_the_root_alone():
    rig, poses = make_rig(), random_poses(3)
    before = joint_features(poses, rig.rest_matrices, rig.parents)
    moved = random_transforms(np.random.default_rng(3)) @ poses
    after = joint_features(moved, rig.rest_matrices, rig.parents)
    np.testing.assert_allclose(after[:, 1:], before[:, 1:], atol=1e-5)
    assert np.abs(after[:, 0] - before[:, 0]).max() > 0.1


def test_translations_are_in_metres():
    rig, poses = replace(make_rig(), metres_per_unit=0.01), random_poses(8)
    scale = np.where(np.arange(12) % 4 == 3, 0.01, 1)
    expected = joint_features(poses, rig.rest_matrices, rig.parents) * scale
    np.testing.assert_allclose(joint_features_in_metres(poses, rig), expected, atol=1e-6)


def test_rounding_does_not_move_features():
    """The character turns as a whole, 100 m from the origin: its joints stay where they are in their parents."""
    rig, rng = make_rig(), np.random.default_rng(5)
    turns = np.array([random_transforms(rng) for _ in range(8)])
    turns[:, :3, 3] += 100
    poses = (turns[:, None] @ rig.rest_matrices).astype(np.float32)
    assert np.ptp(joint_features(poses, rig.rest_matrices, rig.parents)[:, 1:, 3::4], axis=0).max() > 0
    assert np.ptp(joint_features_in_metres(poses, rig)[:, 1:, 3::4], axis=0).max() == 0
