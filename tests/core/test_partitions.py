# SPDX-License-Identifier: GPL-3.0-or-later
"""Partitions by main joint, and the measure of how far a joint moves them."""

import numpy as np

from fdda_addon.core.partition import main_joints, make_partitions, max_residual_changes, partition_colors

from .limb import INFLUENCING, VERTICES, make_rig, partitions_of


def test_main_joint_has_the_largest_weight_and_the_first_wins_a_tie():
    joints = np.array([[3, 1, 0], [2, 5, 0], [4, 0, 0], [7, 6, 2]], np.int32)
    weights = np.array([[0.2, 0.8, 0], [0.5, 0.5, 0], [1, 0, 0], [0.3, 0.3, 0.4]], np.float32)
    found = main_joints(joints, weights)
    assert found.tolist() == [1, 2, 4, 2] and found.dtype == np.int32


def test_partitions_cut_the_mesh():
    rig = make_rig()
    partitions = partitions_of(rig)
    assert [p.joint for p in partitions] == [0, 1, 2, 3]
    assert sorted(np.concatenate([p.vertices for p in partitions]).tolist()) == list(range(VERTICES))
    for p in partitions:
        assert p.vertices.dtype == np.int32 and (np.diff(p.vertices) > 0).all()
        assert p.influencing == INFLUENCING[p.joint]
        heaviest = rig.skin_joints[p.vertices, np.argmax(rig.skin_weights[p.vertices], axis=1)]
        assert (heaviest == p.joint).all()


def test_influencing_joints_may_be_left_out():
    assert all(p.influencing == () for p in make_partitions(make_rig()))


def test_a_partition_may_have_taken_vertices():
    rig = make_rig()
    first, second, *others = partitions_of(rig)
    reassigned = second.vertices[:2].tolist()
    cut = make_partitions(rig, INFLUENCING, reassigned={first.joint: reassigned})
    assert cut[0].vertices.tolist() == sorted([*first.vertices.tolist(), *reassigned])
    assert cut[1].vertices.tolist() == second.vertices[2:].tolist()
    assert [p.vertices.tolist() for p in cut[2:]] == [p.vertices.tolist() for p in others]


def test_residual_changes_are_the_largest_distance_in_each_partition():
    partitions = partitions_of(make_rig())
    base = np.random.default_rng(0).normal(size=(2, VERTICES, 3)).astype(np.float32)
    moved = base.copy()
    moved[1, partitions[1].vertices[2]] += (0.3, 0, -0.4)
    moved[0, partitions[1].vertices[0]] += (0.1, 0, 0)
    moved[0, partitions[3].vertices[-1]] += (0, 0.25, 0)
    expected = [[0, 0.1, 0, 0.25], [0, 0.5, 0, 0]]
    np.testing.assert_allclose(max_residual_changes(partitions, moved, base), expected, atol=1e-6)
    np.testing.assert_allclose(max_residual_changes(partitions, moved[1:], base[1:]), expected[1:], atol=1e-6)


def test_every_partition_has_one_color_of_its_own():
    partitions = partitions_of(make_rig())
    colors = partition_colors(partitions, VERTICES)
    assert colors.shape == (VERTICES, 3) and colors.dtype == np.float32 and colors.max() <= 1
    found = [np.unique(colors[partition.vertices], axis=0) for partition in partitions]
    assert all(len(own) == 1 for own in found)
    assert len(np.unique(np.concatenate(found), axis=0)) == len(partitions)
