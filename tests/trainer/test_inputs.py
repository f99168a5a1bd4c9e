# SPDX-License-Identifier: GPL-3.0-or-later
"""The inputs of the networks that depend on joints."""

import numpy as np
import pytest

from fdda_addon.core.features import joint_features
from fdda_addon.core.partition import Partition, make_partitions
from fdda_addon.core.skinning import skin_matrices
from trainer.inputs.network_inputs import make_inputs, partition_centers

from .chain import chain_angles, chain_rig, pose_chain

PARENTS = np.array([-1, 0, 1, 1, 3])
"""Joint 0 is the parent of joint 1, joint 1 of joints 2 and 3, and joint 3 of joint 4."""


def make_partition(joint: int, *influencing: int) -> Partition:
    return Partition(joint, influencing, np.zeros(0, np.int32))


def pairs(*partitions: Partition) -> list[tuple[int, int]]:
    inputs = make_inputs(PARENTS, np.zeros((5, 1, 3)), partitions)
    return list(zip(inputs.pair_references.tolist(), inputs.pair_points.tolist(), strict=True))


def test_pairs_include_siblings_and_grandchildren():
    assert pairs(make_partition(2, 2, 3, 4)) == [(2, 3), (2, 4)]
    assert pairs(make_partition(0, 1, 3), make_partition(4, 3, 4)) == [(0, 3), (4, 1)]


def test_pairs_need_an_influencing_path():
    assert pairs(make_partition(2, 2, 4)) == []


def test_columns_of_joints_and_pairs():
    inputs = make_inputs(
        PARENTS, np.zeros((5, 1, 3)), [make_partition(2, 2, 3, 4), make_partition(0, 1, 3), make_partition(1)]
    )
    assert inputs.columns[0].tolist() == [*range(24, 60), *range(60, 66)]
    assert inputs.columns[1].tolist() == [*range(12, 24), *range(36, 48), *range(66, 69)]
    assert inputs.columns[2].tolist() == []


def test_controls_are_between_joints_and_pairs():
    partitions = [Partition(2, (2, 3, 4), np.zeros(0, np.int32), (0, 2)), Partition(1, (), np.zeros(0, np.int32), (1,))]
    inputs = make_inputs(PARENTS, np.zeros((5, 1, 3)), partitions, control_count=3)
    assert inputs.columns[0].tolist() == [*range(24, 60), 60, 62, *range(63, 69)]
    assert inputs.columns[1].tolist() == [61]
    poses = np.tile(np.eye(4), (2, 5, 1, 1))
    controls = np.float32([[1, 2, 3], [4, 5, 6]])
    features = inputs.compute_features(poses, np.tile(np.eye(4), (5, 1, 1)), controls)
    assert features.shape == (2, 69) and np.array_equal(features[:, 60:63], controls)
    with pytest.raises(ValueError, match=r"are \(2, 0\) and should be \(2, 3\)"):
        inputs.compute_features(poses, np.tile(np.eye(4), (5, 1, 1)))


def test_a_pair_is_the_center_of_a_partition_in_the_space_of_a_joint():
    rig = chain_rig(4)
    partitions = make_partitions(rig)
    inputs = make_inputs(rig.parents, partition_centers(rig, partitions), [make_partition(1, 1, 2, 3)])
    assert list(zip(inputs.pair_references, inputs.pair_points, strict=True)) == [(1, 3)]
    poses = pose_chain(rig, chain_angles(5, 4, 0))
    features = inputs.compute_features(poses, rig.rest_matrices)
    joints = joint_features(poses, rig.rest_matrices, rig.parents)
    np.testing.assert_array_equal(features[:, :48], joints.reshape(5, -1))
    center = np.append(rig.rest_positions[partitions[3].vertices].mean(axis=0), 1)
    carried = skin_matrices(poses, rig.rest_matrices)[:, 3] @ center
    expected = np.linalg.solve(poses[:, 1], carried[:, :, None])[:, :3, 0]
    np.testing.assert_allclose(features[:, 48:], expected, atol=1e-5)
