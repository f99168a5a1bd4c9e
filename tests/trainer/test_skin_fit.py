# SPDX-License-Identifier: GPL-3.0-or-later
"""The fit of skin weights recovers the true weights, keeps its constraints, and improves poor weights."""

from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.errors import RecordingError
from fdda_addon.core.mathematics.skinning import LinearSkinning
from fdda_addon.core.rig import Fingerprint, Joint, MeshPart, Rig
from trainer.skin.fit_poses import FitPoses, choose_fit_poses
from trainer.skin.solver import fit_skin, simplex_weights
from trainer.skin.split_deformation import measure_skin

from .chain import rotation

JOINTS, VERTICES, POSES = 24, 300, 40


def random_poses(rng: np.random.Generator, heads: np.ndarray, poses: int = POSES) -> np.ndarray:
    """Draw (N, J, 4, 4) float32 matrices. Each joint rotates and moves a little; a common translation moves all far."""
    matrices = np.empty((poses, len(heads), 4, 4))
    for pose in matrices:
        root = rng.normal(0, 5, 3)
        for matrix, head in zip(pose, heads, strict=True):
            matrix[:] = rotation(0, rng.normal(0, 0.5)) @ rotation(1, rng.normal(0, 0.5))
            matrix[:3, 3] = head + rng.normal(0, 0.1, 3) + root
    return matrices.astype(np.float32)


def random_rig(influences: int, origin_distance: float = 0.0) -> Rig:
    """Create a cloud of vertices, `origin_distance` from the origin, skinned to joints at random positions in it."""
    rng = np.random.default_rng(0)
    heads = rng.uniform(-1, 1, (JOINTS, 3)) + origin_distance
    rest_matrices = np.stack([np.eye(4)] * JOINTS)
    rest_matrices[:, :3, 3] = heads
    skin_joints = np.stack([rng.permutation(JOINTS)[:4] for _ in range(VERTICES)]).astype(np.int32)
    weights = rng.uniform(0.1, 1, (VERTICES, 4))
    weights[:, influences:] = 0
    weights[: VERTICES // 3, 1:] = 0
    weights = (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)
    positions = (rng.uniform(-1, 1, (VERTICES, 3)) + origin_distance).astype(np.float32)
    joints = tuple(Joint(str(index), index - 1) for index in range(JOINTS))
    meshes = (MeshPart("mesh", len(positions), Fingerprint("", "", "")),)
    return Rig(joints, positions, rest_matrices.astype(np.float32), skin_joints, weights, meshes)


def with_one_joint(rig: Rig, joints: np.ndarray) -> Rig:
    """Return the rig with each vertex on one joint."""
    weights = np.zeros((rig.vertex_count, 4), np.float32)
    weights[:, 0] = 1
    joint_indices = np.zeros((rig.vertex_count, 4), np.int32)
    joint_indices[:, 0] = joints
    return replace(rig, skin_joints=joint_indices, skin_weights=weights)


def make_fit_poses(rig: Rig, noise: float = 0.0) -> FitPoses:
    """Create poses of the rig for a fit that starts with all weights on the first joint."""
    rng = np.random.default_rng(1)
    matrices = random_poses(rng, rig.rest_matrices[:, :3, 3], POSES)
    positions = LinearSkinning(rig).positions(matrices)
    positions += rng.normal(0, 1, positions.shape).astype(np.float32) * np.float32(noise)
    return FitPoses(
        with_one_joint(rig, np.zeros(rig.vertex_count)),
        matrices,
        positions,
        np.zeros((POSES, 1), np.float32),
        np.zeros(len(rig.joints), bool),
        np.zeros(len(rig.joints), bool),
    )


def fit_rig(poses: FitPoses, kind: str) -> Rig:
    """Return the rig with the fitted weights."""
    joints, weights = fit_skin(poses, kind)
    return replace(poses.rig, skin_joints=joints, skin_weights=weights)


def dense_weights(rig: Rig) -> np.ndarray:
    """Return the skin weights as a (V, J) array."""
    weights = np.zeros((rig.vertex_count, len(rig.joints)))
    np.add.at(weights, (np.arange(rig.vertex_count)[:, None], rig.skin_joints), rig.skin_weights)
    return weights


@pytest.mark.parametrize(("influences", "origin_distance"), [(2, 0), (4, 0), (4, 1000)])
def test_smooth_weights_are_recovered(influences, origin_distance):
    rig = random_rig(influences, origin_distance=origin_distance)
    assert np.abs(dense_weights(fit_rig(make_fit_poses(rig), "smooth")) - dense_weights(rig)).max() < 1e-3


def test_rigid_weights_are_recovered():
    labels = np.random.default_rng(5).integers(0, JOINTS, VERTICES)
    fitted_rig = fit_rig(make_fit_poses(with_one_joint(random_rig(1), labels), noise=0.01), "hard")
    np.testing.assert_array_equal(fitted_rig.skin_joints[:, 0], labels)
    assert (fitted_rig.skin_weights == [1, 0, 0, 0]).all() and (fitted_rig.skin_joints[:, 1:] == 0).all()


@pytest.mark.parametrize("kind", ["hard", "smooth"])
def test_constraints_hold_for_random_positions(kind):
    rig = fit_rig(make_fit_poses(random_rig(4), noise=0.3), kind)
    assert (rig.skin_weights >= 0).all() and (rig.skin_weights > 0).sum(axis=1).max() <= (1 if kind == "hard" else 4)
    np.testing.assert_allclose(rig.skin_weights.sum(axis=1), 1, atol=1e-6)
    assert (np.diff(rig.skin_weights, axis=1) <= 0).all()
    used = [row[weights > 0] for row, weights in zip(rig.skin_joints, rig.skin_weights, strict=True)]
    assert all(len(set(row)) == len(row) for row in used)


def test_noise_adds_no_joints():
    """Every joint explains a little of the noise, but only the true joint explains enough to get a weight."""
    labels = np.random.default_rng(5).integers(0, JOINTS, VERTICES)
    fitted_rig = fit_rig(make_fit_poses(with_one_joint(random_rig(1), labels), noise=0.05), "smooth")
    assert (fitted_rig.skin_weights > 0).sum(axis=1).mean() < 1.02
    np.testing.assert_array_equal(fitted_rig.skin_joints[:, 0], labels)


def test_five_joints_are_approximated_by_the_best_four():
    """The fit has a smaller error than the four heaviest of the five joints that moved each vertex."""
    rig = random_rig(4)
    rig = replace(
        rig,
        skin_joints=np.pad(rig.skin_joints, ((0, 0), (0, 1)), constant_values=JOINTS - 1),
        skin_weights=np.pad(rig.skin_weights * np.float32(0.9), ((0, 0), (0, 1)), constant_values=0.1),
    )
    poses = make_fit_poses(rig)
    heaviest = replace(rig, skin_joints=rig.skin_joints[:, :4], skin_weights=rig.skin_weights[:, :4] / np.float32(0.9))
    fit_errors = measure_skin(replace(poses, rig=heaviest), fit_rig(poses, "smooth"))
    assert fit_errors.rms_mm["fitted"] < 0.8 * fit_errors.rms_mm["rig"]


def test_simplex_weights_are_optimal():
    """The Karush-Kuhn-Tucker conditions hold: slopes are equal where weights are positive, and larger elsewhere."""
    rng = np.random.default_rng(3)
    factors = rng.normal(size=(50, 6, 8)) + rng.normal(size=(50, 1, 8))
    errors = factors @ factors.transpose(0, 2, 1)
    is_usable = rng.random((50, 6)) < 0.8
    is_usable[:, 0] = True
    weights = simplex_weights(errors, is_usable, 1e-12)
    assert (weights >= 0).all() and (weights[~is_usable] == 0).all()
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    slopes = np.einsum("vjk,vk->vj", errors, weights)
    min_slopes = (weights * slopes).sum(axis=1, keepdims=True)
    assert (slopes > min_slopes - 1e-9)[is_usable].all()
    np.testing.assert_allclose(slopes[weights > 0], np.broadcast_to(min_slopes, slopes.shape)[weights > 0], atol=1e-9)
    assert ((weights > 0).sum(axis=1) > 1).any() and ((weights == 0) & is_usable).any()


@pytest.mark.parametrize("kind", ["hard", "smooth"])
def test_ties_prefer_the_rig_s_joint_then_the_nearest(kind):
    rig = with_one_joint(random_rig(1), np.full(VERTICES, 2))
    rest_matrices = rig.rest_matrices.copy()
    rest_matrices[:6, :3, 3] = [[0, 0, 9], [0, 0, 8], [0, 0, 7], [0, 0, 0], [0, 9, 0], [0, 8, 0]]
    rig = replace(rig, rest_matrices=rest_matrices)
    poses = make_fit_poses(rig)
    joint_transforms = poses.pose_matrices[:, 2] @ np.linalg.inv(rest_matrices[2])
    poses.pose_matrices[:, :6] = joint_transforms[:, None] @ rest_matrices[:6]
    rig_joints = np.where(np.arange(VERTICES) < VERTICES // 2, 4, JOINTS - 1)
    fitted_rig = fit_rig(replace(poses, rig=with_one_joint(rig, rig_joints)), kind)
    np.testing.assert_array_equal(fitted_rig.skin_joints[:, 0], np.where(rig_joints == 4, 4, 3))
    np.testing.assert_allclose(fitted_rig.skin_weights[:, 0], 1, atol=1e-4)


def test_static_vertices_follow_the_static_joint():
    poses = make_fit_poses(random_rig(4))
    rest_matrices = poses.rig.rest_matrices.copy()
    rest_matrices[7] = np.eye(4)
    poses.pose_matrices[:, 7] = np.eye(4)
    poses.positions[:, :50] = poses.rig.rest_positions[:50]
    fitted_rig = fit_rig(replace(poses, rig=replace(poses.rig, rest_matrices=rest_matrices)), "smooth")
    assert (fitted_rig.skin_joints[:50, 0] == 7).all() and (fitted_rig.skin_weights[:50, 0] > 0.999).all()


@pytest.mark.parametrize("kind", ["hard", "smooth"])
def test_the_errors_are_measured_on_training_and_held_out_poses(kind):
    poses = make_fit_poses(random_rig(2), noise=0.002)
    training, held_out = poses.subset(slice(0, None, 2)), poses.subset(slice(1, None, 2))
    fitted_rig = fit_rig(training, kind)
    reports = []
    for subset in (held_out, training):
        reports.append(fit_errors := measure_skin(subset, fitted_rig))
        assert fit_errors.rms_mm["fitted"] < 0.8 * fit_errors.rms_mm["rig"]
        skinned = LinearSkinning(fitted_rig).positions(subset.pose_matrices)
        distances = np.linalg.norm(skinned - subset.positions, axis=2)
        np.testing.assert_allclose(fit_errors.rms_mm["fitted"], 1000 * np.sqrt((distances**2).mean()), rtol=1e-4)
        np.testing.assert_allclose(fit_errors.max_mm["fitted"], 1000 * distances.max(), rtol=1e-4)
    if kind == "smooth":
        # The noise of √3 · 2 mm remains. Held-out poses have a slightly larger error.
        assert 3.3 < reports[1].rms_mm["fitted"] < reports[0].rms_mm["fitted"] < 4


@pytest.mark.parametrize(
    ("pose_count", "vertex_count", "random_count", "expected"),
    [(1000, 300, 0, (0, 300)), (1000, 300, 500, (200, 100)), (40, 300, 0, (0, 40)), (1000, 10**7, 0, (0, 10))],
)
def test_poses_of_a_fit_are_spaced_evenly(pose_count, vertex_count, random_count, expected):
    chosen = choose_fit_poses(pose_count, vertex_count, random_count)
    assert ((chosen < random_count).sum(), (chosen >= random_count).sum()) == expected
    assert chosen[0] == 0 and chosen[-1] == pose_count - 1 and (np.diff(chosen) > 0).all()


def test_too_few_poses_are_refused():
    with pytest.raises(RecordingError, match="Skin weights are fitted to at least 10 poses, and the recording has 9"):
        choose_fit_poses(9, 300)
