# SPDX-License-Identifier: GPL-3.0-or-later
"""Linear skinning and the local residuals against the formulas, written out vertex by vertex."""

import numpy as np
import pytest

from fdda_addon.core.errors import RigError
from fdda_addon.core.skinning import LinearSkinning, SkinBlock, skin_matrices

from .limb import JOINTS, VERTICES, make_rig, partitions_of, random_poses, random_residuals, random_transforms


@pytest.fixture(scope="module")
def rig():
    return make_rig()


def skinned_by_hand(rig, pose: np.ndarray) -> np.ndarray:
    """(V, 3): sum_j w_vj P_j B_j^-1 x_v, one vertex and one joint after the other."""
    positions = np.zeros((rig.vertex_count, 3))
    for vertex in range(rig.vertex_count):
        for joint, weight in zip(rig.skin_joints[vertex], rig.skin_weights[vertex], strict=True):
            skin = pose[joint].astype(np.float64) @ np.linalg.inv(rig.rest_matrices[joint].astype(np.float64))
            positions[vertex] += weight * (skin @ np.append(rig.rest_positions[vertex], 1))[:3]
    return positions


def test_linear_skinning_is_the_weighted_sum_of_the_joints(rig):
    poses = random_poses(6)
    positions = LinearSkinning(rig).positions(poses)
    assert positions.shape == (6, VERTICES, 3) and positions.dtype == np.float32
    for pose, result in zip(poses, positions, strict=True):
        np.testing.assert_allclose(result, skinned_by_hand(rig, pose), atol=2e-6)


def test_rest_pose_gives_the_rest_positions(rig):
    np.testing.assert_allclose(LinearSkinning(rig).positions(rig.rest_matrices[None])[0], rig.rest_positions, atol=1e-6)


def test_skin_matrices_of_the_rest_pose_are_the_identity(rig):
    skin = skin_matrices(rig.rest_matrices[None], rig.rest_matrices)
    assert skin.dtype == np.float32
    np.testing.assert_allclose(skin[0], np.tile(np.eye(4), (len(JOINTS), 1, 1)), atol=1e-6)


def test_local_residuals_are_residuals_in_the_frame_of_the_main_joint(rig):
    poses = random_poses(3)
    positions = np.random.default_rng(5).uniform(-1, 1, (3, VERTICES, 3)).astype(np.float32)
    local = LinearSkinning(rig).local_residuals(poses, positions)
    for number, pose in enumerate(poses):
        linear = skinned_by_hand(rig, pose)
        for vertex in range(VERTICES):
            main = rig.skin_joints[vertex, np.argmax(rig.skin_weights[vertex])]
            turn = (pose[main].astype(np.float64) @ np.linalg.inv(rig.rest_matrices[main].astype(np.float64)))[:3, :3]
            expected = np.linalg.solve(turn, positions[number, vertex] - linear[vertex])
            np.testing.assert_allclose(local[number, vertex], expected, atol=1e-5)


def test_complex_positions_undo_local_residuals(rig):
    skinning, poses, local = LinearSkinning(rig, partitions_of(rig)), random_poses(5), random_residuals(5)
    positions = skinning.complex_positions(poses, local)
    assert np.abs(positions - skinning.positions(poses)).max() > 1e-3
    np.testing.assert_allclose(skinning.local_residuals(poses, positions), local, atol=2e-6)
    np.testing.assert_allclose(
        skinning.complex_positions(poses, skinning.local_residuals(poses, positions)), positions, atol=2e-6
    )


def test_local_residuals_do_not_see_the_ancestors_move(rig):
    """A motion of everything from outside, rotation, scale and all, leaves them as they are; residuals change."""
    skinning, poses, local = LinearSkinning(rig), random_poses(4), random_residuals(4)
    positions = skinning.complex_positions(poses, local)
    motion = random_transforms(np.random.default_rng(9))
    moved_poses = (motion @ poses).astype(np.float32)
    moved = (positions @ motion[:3, :3].T + motion[:3, 3]).astype(np.float32)
    np.testing.assert_allclose(skinning.local_residuals(moved_poses, moved), local, atol=5e-6)
    change = (moved - skinning.positions(moved_poses)) - (positions - skinning.positions(poses))
    assert np.abs(change).max() > 1e-3


def test_a_joint_without_extent_has_no_local_residuals(rig):
    poses = random_poses(1)
    poses[0, 2, :3, :3] = 0
    with pytest.raises(RigError, match=r"^Bone '.*' has a scale of zero in some pose; look for a constraint or driver"):
        LinearSkinning(rig).local_residuals(poses, np.zeros((1, VERTICES, 3), np.float32))


@pytest.mark.parametrize("count", [1, 2, 3, 7, 20])
def test_a_pose_has_the_same_bits_among_any_number_of_others(rig, count):
    poses, skinning = random_poses(40), LinearSkinning(rig)
    positions = skinning.positions(poses)
    assert skinning.positions(poses[:count]).tobytes() == positions[:count].tobytes()
    residuals = skinning.local_residuals(poses, positions + 0.01)
    assert skinning.local_residuals(poses[-count:], positions[-count:] + 0.01).tobytes() == residuals[-count:].tobytes()


def test_skin_block_lists_the_joints_with_weight(rig):
    for partition in partitions_of(rig):
        joints, weights = rig.skin_joints[partition.vertices], rig.skin_weights[partition.vertices]
        block = SkinBlock(rig, partition)
        assert block.joints.tolist() == sorted(set(joints[weights > 0].tolist()))
        assert block.weighted_rest.shape == (4 * len(block.joints), len(partition.vertices))
        # The fourth row of each joint holds its weights.
        np.testing.assert_allclose(block.weighted_rest[3::4].sum(axis=0), 1, atol=1e-6)
