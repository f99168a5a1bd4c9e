# SPDX-License-Identifier: GPL-3.0-or-later
"""Joint features, the inputs of the networks, compared with their formula."""

from dataclasses import replace

import numpy as np

from fdda_addon.core.mathematics.features import joint_features, joint_features_in_metres

from ..limb import JOINTS, make_rig, random_poses, random_transforms


def reference_features(pose: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Compute (J, 12) features of one pose joint by joint: (B_p^-1 B_j)^-1 P_p^-1 P_j."""
    feature_rows = []
    for joint_index, joint in enumerate(JOINTS):
        parent_pose, parent_rest = (
            (np.eye(4), np.eye(4)) if joint.parent < 0 else (pose[joint.parent], rest[joint.parent])
        )
        rest_relative = np.linalg.inv(parent_rest) @ rest[joint_index]
        feature_rows.append(
            (np.linalg.inv(rest_relative) @ np.linalg.inv(parent_pose) @ pose[joint_index])[:3].reshape(12)
        )
    return np.array(feature_rows)


def test_features_of_the_rest_pose_are_the_identity():
    rig = make_rig()
    features = joint_features(rig.rest_matrices[None], rig.rest_matrices, rig.parents)
    assert features.shape == (1, len(JOINTS), 12) and features.dtype == np.float32
    np.testing.assert_allclose(features[0], np.tile(np.eye(4)[:3].reshape(12), (len(JOINTS), 1)), atol=1e-6)


def test_features_equal_the_formula():
    rig, poses = make_rig(), random_poses(8)
    features = joint_features(poses, rig.rest_matrices, rig.parents)
    for pose, pose_features in zip(poses.astype(np.float64), features, strict=True):
        np.testing.assert_allclose(
            pose_features, reference_features(pose, rig.rest_matrices.astype(np.float64)), atol=1e-5
        )


def test_moving_the_root_changes_only_the_features_of_the_root():
    rig, poses = make_rig(), random_poses(3)
    features = joint_features(poses, rig.rest_matrices, rig.parents)
    moved_poses = random_transforms(np.random.default_rng(3)) @ poses
    moved_features = joint_features(moved_poses, rig.rest_matrices, rig.parents)
    np.testing.assert_allclose(moved_features[:, 1:], features[:, 1:], atol=1e-5)
    assert np.abs(moved_features[:, 0] - features[:, 0]).max() > 0.1


def test_translations_are_in_metres():
    rig, poses = replace(make_rig(), metres_per_unit=0.01), random_poses(8)
    scale = np.where(np.arange(12) % 4 == 3, 0.01, 1)
    expected = joint_features(poses, rig.rest_matrices, rig.parents) * scale
    np.testing.assert_allclose(joint_features_in_metres(poses, rig), expected, atol=1e-6)


def test_rounding_does_not_change_features():
    """The whole character moves 100 m from the origin; each joint keeps its transform relative to its parent."""
    rig, rng = make_rig(), np.random.default_rng(5)
    motions = np.array([random_transforms(rng) for _ in range(8)])
    motions[:, :3, 3] += 100
    poses = (motions[:, None] @ rig.rest_matrices).astype(np.float32)
    assert np.ptp(joint_features(poses, rig.rest_matrices, rig.parents)[:, 1:, 3::4], axis=0).max() > 0
    assert np.ptp(joint_features_in_metres(poses, rig)[:, 1:, 3::4], axis=0).max() == 0
