# SPDX-License-Identifier: GPL-3.0-or-later
"""Linear skinning and local residuals, compared with their formulas, which are computed vertex by vertex."""

import numpy as np
import pytest

from fdda_addon.core.errors import RigError
from fdda_addon.core.mathematics.skinning import LinearSkinning, SkinBlock, skin_matrices

from ..limb import JOINTS, VERTEX_COUNT, make_rig, partitions_of, random_poses, random_positions, random_transforms


@pytest.fixture(scope="module")
def rig():
    """The rig of the limb."""
    return make_rig()


def reference_skinning(rig, pose: np.ndarray) -> np.ndarray:
    """Compute (V, 3) positions sum_j w_vj P_j B_j^-1 x_v with a loop over vertices and joints."""
    positions = np.zeros((rig.vertex_count, 3))
    for vertex in range(rig.vertex_count):
        for joint, weight in zip(rig.skin_joints[vertex], rig.skin_weights[vertex], strict=True):
            skin_matrix = pose[joint].astype(np.float64) @ np.linalg.inv(rig.rest_matrices[joint].astype(np.float64))
            positions[vertex] += weight * (skin_matrix @ np.append(rig.rest_positions[vertex], 1))[:3]
    return positions


def test_linear_skinning_is_the_weighted_sum_of_the_joints(rig):
    poses = random_poses(6)
    positions = LinearSkinning(rig).positions(poses)
    assert positions.shape == (6, VERTEX_COUNT, 3) and positions.dtype == np.float32
    for pose, result in zip(poses, positions, strict=True):
        np.testing.assert_allclose(result, reference_skinning(rig, pose), atol=2e-6)


def test_skin_matrices_of_the_rest_pose_are_the_identity(rig):
    skin = skin_matrices(rig.rest_matrices[None], rig.rest_matrices)
    assert skin.dtype == np.float32
    np.testing.assert_allclose(skin[0], np.tile(np.eye(4), (len(JOINTS), 1, 1)), atol=1e-6)


def test_local_residuals_are_in_the_space_of_the_main_joint(rig):
    poses = random_poses(3)
    positions = np.random.default_rng(5).uniform(-1, 1, (3, VERTEX_COUNT, 3)).astype(np.float32)
    local_residuals = LinearSkinning(rig).local_residuals(poses, positions)
    for pose_index, pose in enumerate(poses):
        linear_positions = reference_skinning(rig, pose)
        for vertex in range(VERTEX_COUNT):
            main_joint = rig.skin_joints[vertex, np.argmax(rig.skin_weights[vertex])]
            skin_rotation = (
                pose[main_joint].astype(np.float64) @ np.linalg.inv(rig.rest_matrices[main_joint].astype(np.float64))
            )[:3, :3]
            expected = np.linalg.solve(skin_rotation, positions[pose_index, vertex] - linear_positions[vertex])
            np.testing.assert_allclose(local_residuals[pose_index, vertex], expected, atol=1e-5)


def test_complex_positions_invert_local_residuals(rig):
    skinning, poses, local_residuals = LinearSkinning(rig, partitions_of(rig)), random_poses(5), random_positions(5)
    positions = skinning.complex_positions(poses, local_residuals)
    assert np.abs(positions - skinning.positions(poses)).max() > 1e-3
    np.testing.assert_allclose(skinning.local_residuals(poses, positions), local_residuals, atol=2e-6)
    np.testing.assert_allclose(
        skinning.complex_positions(poses, skinning.local_residuals(poses, positions)), positions, atol=2e-6
    )


def test_local_residuals_do_not_depend_on_the_motion_of_the_whole_rig(rig):
    """Rotating, scaling and moving everything changes the residuals, but not the local residuals."""
    skinning, poses, local_residuals = LinearSkinning(rig), random_poses(4), random_positions(4)
    positions = skinning.complex_positions(poses, local_residuals)
    motion = random_transforms(np.random.default_rng(9))
    moved_poses = (motion @ poses).astype(np.float32)
    moved_positions = (positions @ motion[:3, :3].T + motion[:3, 3]).astype(np.float32)
    np.testing.assert_allclose(skinning.local_residuals(moved_poses, moved_positions), local_residuals, atol=5e-6)
    residual_change = (moved_positions - skinning.positions(moved_poses)) - (positions - skinning.positions(poses))
    assert np.abs(residual_change).max() > 1e-3


def test_local_residuals_with_a_joint_scale_of_zero_are_refused(rig):
    poses = random_poses(1)
    poses[0, 2, :3, :3] = 0
    with pytest.raises(
        RigError, match=r"^Bone '.*' has a scale of zero in some pose; look for the key, constraint or driver"
    ):
        LinearSkinning(rig).local_residuals(poses, np.zeros((1, VERTEX_COUNT, 3), np.float32))


@pytest.mark.parametrize("count", [1, 2, 3, 7, 20])
def test_the_batch_size_does_not_change_the_bits_of_a_pose(rig, count):
    poses, skinning = random_poses(40), LinearSkinning(rig)
    positions = skinning.positions(poses)
    assert skinning.positions(poses[:count]).tobytes() == positions[:count].tobytes()
    residuals = skinning.local_residuals(poses, positions + 0.01)
    assert skinning.local_residuals(poses[-count:], positions[-count:] + 0.01).tobytes() == residuals[-count:].tobytes()


def test_skin_block_lists_the_joints_with_weight(rig):
    for partition in partitions_of(rig):
        joints, weights = rig.skin_joints[partition.vertices], rig.skin_weights[partition.vertices]
        block = SkinBlock(rig, partition.joint, partition.vertices)
        assert block.joints.tolist() == sorted(set(joints[weights > 0].tolist()))
        assert block.weighted_rest.shape == (4 * len(block.joints), len(partition.vertices))
        # Every fourth row contains the weights of a joint.
        np.testing.assert_allclose(block.weighted_rest[3::4].sum(axis=0), 1, atol=1e-6)
