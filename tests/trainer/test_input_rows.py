# SPDX-License-Identifier: GPL-3.0-or-later
"""What a network sees of the joints."""

import numpy as np
from chain import chain_angles, chain_rig, pose_chain

from fdda_addon.core.features import joint_features
from fdda_addon.core.partition import Partition
from fdda_addon.core.skinning import skin_matrices
from trainer.inputs import make_input_rows

PARENTS = np.array([-1, 0, 1, 1, 3])
"""0 carries 1, which carries 2 and 3; 3 carries 4."""


def partition(joint: int, *influencing: int) -> Partition:
    return Partition(joint, influencing, np.zeros(0, np.int32))


def pairs(rows, number: int) -> set[tuple[int, int]]:
    return {(int(rows.references[row]), int(rows.joints[row])) for row in rows.rows[number]}


def test_siblings_and_grandchildren_are_seen_from_the_main_joint():
    rows = make_input_rows(PARENTS, [partition(2, 2, 3, 4), partition(0, 1, 3)])
    assert pairs(rows, 0) == {(1, 2), (1, 3), (3, 4), (2, 3), (2, 4)}
    assert pairs(rows, 1) == {(0, 1), (1, 3), (0, 3)}


def test_a_joint_that_does_not_influence_hides_what_lies_behind_it():
    rows = make_input_rows(PARENTS, [partition(2, 2, 4)])
    assert pairs(rows, 0) == {(1, 2), (3, 4)}


def test_features_are_those_of_core_and_identities_in_the_rest_pose():
    rig = chain_rig(4)
    rows = make_input_rows(rig.parents, [partition(1, 1, 2, 3)])
    poses = pose_chain(rig, chain_angles(5, 4, 0))
    features = rows.features(poses, rig.rest_matrices)
    np.testing.assert_array_equal(features[:, :4], joint_features(poses, rig.rest_matrices, rig.parents))
    rest = rows.features(rig.rest_matrices[None], rig.rest_matrices)
    np.testing.assert_allclose(rest.reshape(-1, 3, 4), np.tile(np.eye(3, 4), (rest.shape[1], 1, 1)), atol=1e-6)
    # Joint 3 seen from joint 1, the other way round: what the skin matrices say, in the axes of joint 3.
    skin, bind = skin_matrices(poses, rig.rest_matrices), rig.rest_matrices[3]
    number = next(r for r in rows.rows[0] if (rows.references[r], rows.joints[r]) == (1, 3))
    expected = np.linalg.inv(bind) @ np.linalg.inv(skin[:, 1]) @ skin[:, 3] @ bind
    np.testing.assert_allclose(features[:, number].reshape(-1, 3, 4), expected[:, :3], atol=1e-5)
