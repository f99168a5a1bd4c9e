# SPDX-License-Identifier: GPL-3.0-or-later
"""The joint regression: it recovers smooth skinning, and ignores a common motion of the joints."""

from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.partition import Partition, make_partitions
from fdda_addon.core.rig import Joint, Rig
from fdda_addon.core.skinning import LinearSkinning, skin_matrices
from trainer.joint_fit import joint_regression

from .chain import chain_angles, chain_rig, pose_chain, rotation

JOINTS = 4
INFLUENCING = {joint: tuple(j for j in (joint, joint + 1) if 0 < j < JOINTS) for joint in range(JOINTS)}


def hard(rig: Rig) -> Rig:
    """The rig with each vertex on one joint."""
    heaviest = rig.skin_weights == rig.skin_weights.max(axis=1, keepdims=True)
    heaviest[:, 1] &= ~heaviest[:, 0]
    return replace(rig, skin_weights=heaviest.astype(np.float32))


@pytest.fixture(scope="module")
def smooth() -> Rig:
    return chain_rig(JOINTS)


@pytest.fixture(scope="module")
def poses(smooth) -> np.ndarray:
    """(320, J, 4, 4); the chain is far away from the origin."""
    there = np.eye(4, dtype=np.float32)
    there[:3, 3] = 7, -5, 3
    return there @ pose_chain(smooth, chain_angles(320, JOINTS, seed=4))


TRAINING = np.arange(300)


@pytest.mark.parametrize("joint", range(JOINTS))
def test_smooth_skinning_is_recovered(smooth, poses, joint):
    """The true rig has smooth weights, linear skinning hard ones: nothing remains to learn, on unseen poses too."""
    rig = hard(smooth)
    partition = make_partitions(rig, INFLUENCING)[joint]
    skinning = LinearSkinning(rig)
    truth = LinearSkinning(smooth).positions(poses)
    residuals = skinning.local_residuals(poses, truth)[:, partition.vertices]
    skin = skin_matrices(poses, rig.rest_matrices)
    fit, left = joint_regression(rig, partition, skin).fit(residuals, TRAINING)
    assert np.abs(residuals).max() > 5e-3 and np.abs(left).max() < 1e-4
    fitted = skinning.positions(poses)[:, partition.vertices] + fit.offsets(skin)
    np.testing.assert_allclose(fitted, truth[:, partition.vertices], atol=1e-4)


def test_irrelevant_joints_are_removed(smooth, poses):
    """The last joint is a regressor and moves, but the residual of the first depends on the second alone."""
    rig = hard(smooth)
    partition = make_partitions(rig, {0: (1, 2, 3)})[0]
    skin = skin_matrices(poses, rig.rest_matrices)
    residuals = LinearSkinning(rig).local_residuals(poses, LinearSkinning(smooth).positions(poses))[
        :, partition.vertices
    ]
    noise = np.random.default_rng(1).normal(0, 1e-3, residuals.shape).astype(np.float32)
    regression = joint_regression(rig, partition, skin)
    assert regression.joints.tolist() == [0, 1, 2, 3]
    fit, left = regression.fit(residuals + noise, TRAINING)
    assert fit.joints.tolist() == [0, 1]
    assert np.abs(left - noise).max() < 1e-3 < np.abs(residuals).max() / 5


def random_residuals(rig: Rig, partition: Partition, count: int) -> np.ndarray:
    size = (count, len(partition.vertices), 3)
    return np.random.default_rng(0).normal(0.01, 0.004, size).astype(np.float32)


def test_offsets_and_remainder_sum_to_the_residuals(smooth, poses):
    partition = make_partitions(smooth, INFLUENCING)[1]
    skin = skin_matrices(poses, smooth.rest_matrices)
    residuals = random_residuals(smooth, partition, len(poses))
    fit, left = joint_regression(smooth, partition, skin).fit(residuals, TRAINING)
    inverse = np.linalg.inv(skin[:, partition.joint, :3, :3].astype(np.float64))
    offsets = np.einsum("nab,nvb->nva", inverse, fit.offsets(skin))
    np.testing.assert_allclose(offsets + left, residuals, atol=1e-5)
    assert (left[TRAINING] ** 2).mean() < 0.3 * (residuals[TRAINING] ** 2).mean(), "not even the mean was fitted"


def test_offsets_rotate_with_the_character(smooth, poses):
    partition = make_partitions(smooth, INFLUENCING)[1]
    skin = skin_matrices(poses, smooth.rest_matrices)
    fit, _ = joint_regression(smooth, partition, skin).fit(random_residuals(smooth, partition, len(poses)), TRAINING)
    moved = rotation(1, 0.8)
    moved[:3, 3] = 3, 20, -1
    expected = fit.offsets(skin) @ moved[:3, :3].T
    np.testing.assert_allclose(fit.offsets((moved @ skin).astype(np.float32)), expected, atol=1e-4)


def test_joints_that_only_influencing_joints_move():
    parents = (-1, 0, 1, 1, 3)
    rig = replace(chain_rig(5), joints=tuple(Joint(f"bone_{n}", parent) for n, parent in enumerate(parents)))
    skin = np.tile(np.eye(4, dtype=np.float32), (2, 5, 1, 1))

    def around(joint: int, *influencing: int) -> list[int]:
        return joint_regression(rig, Partition(joint, influencing, np.arange(3)), skin).joints.tolist()

    assert around(2, 2, 3) == [2, 1, 3]
    assert around(2, 2, 4) == [2, 1], "joint 3 hides joint 4"
    assert around(1, 1, 2, 3, 4) == [1, 0, 2, 3, 4]
    assert around(0) == [0]


def test_the_main_joint_alone_fits_the_mean(smooth, poses):
    partition = make_partitions(smooth, INFLUENCING)[2]
    skin = skin_matrices(poses, smooth.rest_matrices)
    residuals = random_residuals(smooth, partition, len(poses))
    fit, left = joint_regression(smooth, partition, skin).main_joint_only().fit(residuals, TRAINING)
    assert fit.joints.tolist() == [2]
    np.testing.assert_allclose(left, residuals - residuals[TRAINING].mean(axis=0), atol=1e-6)


def test_joints_that_never_moved_get_small_factors(smooth):
    """All regressors are then equal; one of the joints moves later."""
    partition = make_partitions(smooth, INFLUENCING)[1]
    still = pose_chain(smooth, np.zeros((30, JOINTS, 2)))
    skin = skin_matrices(still, smooth.rest_matrices)
    residuals = random_residuals(smooth, partition, 30)
    fit, _ = joint_regression(smooth, partition, skin).fit(residuals, np.arange(30))
    assert np.abs(fit.factors).max() < 0.1
    bent = skin_matrices(pose_chain(smooth, np.full((1, JOINTS, 2), 0.5)), smooth.rest_matrices)
    assert np.abs(fit.offsets(bent)).max() < 0.1
