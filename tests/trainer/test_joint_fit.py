# SPDX-License-Identifier: GPL-3.0-or-later
"""The joint regression recovers smooth skinning, and ignores a common motion of the joints."""

from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.mathematics.partition import Partition, make_partitions
from fdda_addon.core.mathematics.skinning import LinearSkinning, skin_matrices
from fdda_addon.core.rig import Joint, Rig
from trainer.fits.joint_fit import joint_regression

from .chain import chain_angles, chain_rig, pose_chain, rotation

JOINTS = 4
INFLUENCING = {joint: tuple(j for j in (joint, joint + 1) if 0 < j < JOINTS) for joint in range(JOINTS)}


def with_heaviest_joints(rig: Rig) -> Rig:
    """Return the rig with each vertex on its heaviest joint."""
    is_heaviest = rig.skin_weights == rig.skin_weights.max(axis=1, keepdims=True)
    is_heaviest[:, 1] &= ~is_heaviest[:, 0]
    return replace(rig, skin_weights=is_heaviest.astype(np.float32))


@pytest.fixture(scope="module")
def smooth_rig() -> Rig:
    return chain_rig(JOINTS)


@pytest.fixture(scope="module")
def poses(smooth_rig) -> np.ndarray:
    """(320, J, 4, 4) pose matrices of the chain, far away from the origin."""
    translation = np.eye(4, dtype=np.float32)
    translation[:3, 3] = 7, -5, 3
    return translation @ pose_chain(smooth_rig, chain_angles(320, JOINTS, seed=4))


TRAINING = np.arange(300)


@pytest.mark.parametrize("joint", range(JOINTS))
def test_smooth_skinning_is_recovered(smooth_rig, poses, joint):
    """The true rig has smooth weights, and linear skinning has one joint per vertex. The fit explains all residuals."""
    rig = with_heaviest_joints(smooth_rig)
    partition = make_partitions(rig, INFLUENCING)[joint]
    skinning = LinearSkinning(rig)
    truth = LinearSkinning(smooth_rig).positions(poses)
    residuals = skinning.local_residuals(poses, truth)[:, partition.vertices]
    skin = skin_matrices(poses, rig.rest_matrices)
    fit, remainder = joint_regression(rig, partition, skin).fit(residuals, TRAINING)
    assert np.abs(residuals).max() > 5e-3 and np.abs(remainder).max() < 1e-4
    fitted = skinning.positions(poses)[:, partition.vertices] + fit.compute_offsets(skin)
    np.testing.assert_allclose(fitted, truth[:, partition.vertices], atol=1e-4)


def test_irrelevant_joints_are_removed(smooth_rig, poses):
    """All four joints are regressors, but the residual of the first partition depends on the second joint alone."""
    rig = with_heaviest_joints(smooth_rig)
    partition = make_partitions(rig, {0: (1, 2, 3)})[0]
    skin = skin_matrices(poses, rig.rest_matrices)
    residuals = LinearSkinning(rig).local_residuals(poses, LinearSkinning(smooth_rig).positions(poses))[
        :, partition.vertices
    ]
    noise = np.random.default_rng(1).normal(0, 1e-3, residuals.shape).astype(np.float32)
    regression = joint_regression(rig, partition, skin)
    assert regression.joints.tolist() == [0, 1, 2, 3]
    fit, remainder = regression.fit(residuals + noise, TRAINING)
    assert fit.joints.tolist() == [0, 1]
    assert np.abs(remainder - noise).max() < 1e-3 < np.abs(residuals).max() / 5


def random_residuals(rig: Rig, partition: Partition, count: int) -> np.ndarray:
    shape = (count, len(partition.vertices), 3)
    return np.random.default_rng(0).normal(0.01, 0.004, shape).astype(np.float32)


def test_offsets_and_remainder_sum_to_the_residuals(smooth_rig, poses):
    partition = make_partitions(smooth_rig, INFLUENCING)[1]
    skin = skin_matrices(poses, smooth_rig.rest_matrices)
    residuals = random_residuals(smooth_rig, partition, len(poses))
    fit, remainder = joint_regression(smooth_rig, partition, skin).fit(residuals, TRAINING)
    inverse = np.linalg.inv(skin[:, partition.joint, :3, :3].astype(np.float64))
    offsets = np.einsum("nab,nvb->nva", inverse, fit.compute_offsets(skin))
    np.testing.assert_allclose(offsets + remainder, residuals, atol=1e-5)
    assert (remainder[TRAINING] ** 2).mean() < 0.3 * (residuals[TRAINING] ** 2).mean(), "not even the mean was fitted"


def test_offsets_rotate_with_the_character(smooth_rig, poses):
    partition = make_partitions(smooth_rig, INFLUENCING)[1]
    skin = skin_matrices(poses, smooth_rig.rest_matrices)
    fit, _ = joint_regression(smooth_rig, partition, skin).fit(
        random_residuals(smooth_rig, partition, len(poses)), TRAINING
    )
    character_transform = rotation(1, 0.8)
    character_transform[:3, 3] = 3, 20, -1
    expected = fit.compute_offsets(skin) @ character_transform[:3, :3].T
    np.testing.assert_allclose(
        fit.compute_offsets((character_transform @ skin).astype(np.float32)), expected, atol=1e-4
    )


def test_the_fit_has_the_joints_that_only_influencing_joints_move():
    parents = (-1, 0, 1, 1, 3)
    rig = replace(chain_rig(5), joints=tuple(Joint(f"bone_{n}", parent) for n, parent in enumerate(parents)))
    skin = np.tile(np.eye(4, dtype=np.float32), (2, 5, 1, 1))

    def fitted_joints(joint: int, *influencing: int) -> list[int]:
        return joint_regression(rig, Partition(joint, influencing, np.arange(3)), skin).joints.tolist()

    assert fitted_joints(2, 2, 3) == [2, 1, 3]
    assert fitted_joints(2, 2, 4) == [2, 1], "joint 3 hides joint 4"
    assert fitted_joints(1, 1, 2, 3, 4) == [1, 0, 2, 3, 4]
    assert fitted_joints(0) == [0]


def test_the_main_joint_alone_fits_the_mean(smooth_rig, poses):
    partition = make_partitions(smooth_rig, INFLUENCING)[2]
    skin = skin_matrices(poses, smooth_rig.rest_matrices)
    residuals = random_residuals(smooth_rig, partition, len(poses))
    fit, remainder = joint_regression(smooth_rig, partition, skin).main_joint_only().fit(residuals, TRAINING)
    assert fit.joints.tolist() == [2]
    np.testing.assert_allclose(remainder, residuals - residuals[TRAINING].mean(axis=0), atol=1e-6)


def test_joints_that_never_moved_get_small_factors(smooth_rig):
    """No joint moves in the training poses, so all regressors are equal. A joint that moves later has little effect."""
    partition = make_partitions(smooth_rig, INFLUENCING)[1]
    still_poses = pose_chain(smooth_rig, np.zeros((30, JOINTS, 2)))
    skin = skin_matrices(still_poses, smooth_rig.rest_matrices)
    residuals = random_residuals(smooth_rig, partition, 30)
    fit, _ = joint_regression(smooth_rig, partition, skin).fit(residuals, np.arange(30))
    assert np.abs(fit.factors).max() < 0.1
    bent_skin = skin_matrices(pose_chain(smooth_rig, np.full((1, JOINTS, 2), 0.5)), smooth_rig.rest_matrices)
    assert np.abs(fit.compute_offsets(bent_skin)).max() < 0.1


def test_joints_that_move_alike_share_the_fit(smooth_rig):
    """In the training poses all joints bend in proportion, as with twist bones. Then a constraint of one is muted."""
    rig, proportions = with_heaviest_joints(smooth_rig), np.array([0, 1, 0.6, 0.3])
    angles = np.random.default_rng(0).uniform(0, 1.9, (300, 1, 1)) * proportions[:, None] * [1, 0]
    training_poses = pose_chain(smooth_rig, angles)
    muted_poses = pose_chain(smooth_rig, np.array([[0, 0], [1.2, 0], [0, 0], [0.36, 0]])[None])
    partition = make_partitions(rig, {1: (1, 2, 3)})[1]
    skin = skin_matrices(training_poses, rig.rest_matrices)
    # What smoothing does is not linear in the transforms.
    residuals = np.sin(angles[:, 1:2, :1]) ** 2 * random_residuals(rig, partition, 1)
    fit, remainder = joint_regression(rig, partition, skin).fit(residuals.astype(np.float32), TRAINING)
    assert np.sqrt((remainder**2).mean()) < 0.4 * np.sqrt((residuals**2).mean())
    offsets = fit.compute_offsets(skin_matrices(muted_poses, rig.rest_matrices))
    assert np.abs(offsets).max() < 2 * np.abs(residuals).max()
