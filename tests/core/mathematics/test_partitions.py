# SPDX-License-Identifier: GPL-3.0-or-later
"""Partitions by main joint."""

from dataclasses import replace

import numpy as np

from fdda_addon.core.mathematics.partition import (
    assume_nearby_influences,
    main_joints,
    make_partitions,
    partition_colors,
)

from ..limb import INFLUENCING, VERTEX_COUNT, make_rig, partitions_of


def test_main_joint_is_the_first_with_the_largest_weight():
    joints = np.array([[3, 1, 0], [2, 5, 0], [4, 0, 0], [7, 6, 2]], np.int32)
    weights = np.array([[0.2, 0.8, 0], [0.5, 0.5, 0], [1, 0, 0], [0.3, 0.3, 0.4]], np.float32)
    computed_joints = main_joints(joints, weights)
    assert computed_joints.tolist() == [1, 2, 4, 2] and computed_joints.dtype == np.int32


def test_each_vertex_is_in_the_partition_of_its_main_joint():
    rig = make_rig()
    partitions = partitions_of(rig)
    assert [p.joint for p in partitions] == [0, 1, 2, 3]
    assert sorted(np.concatenate([p.vertices for p in partitions]).tolist()) == list(range(VERTEX_COUNT))
    for p in partitions:
        assert p.vertices.dtype == np.int32 and (np.diff(p.vertices) > 0).all()
        assert p.influencing == INFLUENCING[p.joint]
        heaviest = rig.skin_joints[p.vertices, np.argmax(rig.skin_weights[p.vertices], axis=1)]
        assert (heaviest == p.joint).all()


def test_influencing_joints_may_be_left_out():
    assert all(p.influencing == () for p in make_partitions(make_rig()))


def test_assumed_influences_are_near_joints_with_all_ancestors():
    """Joint 2, 'lower', has a face with 'thumb'; the direction of gravity comes from the ancestors up to the root."""
    rig = make_rig()
    joints = np.arange(VERTEX_COUNT)[:, None] % 4 * np.array([1, 0, 0, 0])
    rig = replace(rig, skin_joints=joints.astype(np.int32), skin_weights=np.eye(4, dtype=np.float32)[np.zeros(40, int)])
    for corners, of_lower in (([0, 4, 8], (0, 1, 2)), ([2, 3, 6], (0, 1, 2, 3))):
        faces = {"face_starts": np.zeros(1, np.int32), "face_vertices": np.array(corners, np.int32)}
        partitions = assume_nearby_influences(replace(rig, **faces), make_partitions(rig))
        of_thumb = (0, 1, 3) if len(of_lower) == 3 else of_lower
        assert [p.influencing for p in partitions] == [(0,), (0, 1), of_lower, of_thumb]


def test_every_partition_has_one_distinct_color():
    partitions = partitions_of(make_rig())
    colors = partition_colors(partitions, VERTEX_COUNT)
    assert colors.shape == (VERTEX_COUNT, 3) and colors.dtype == np.float32 and colors.max() <= 1
    partition_color_rows = [np.unique(colors[partition.vertices], axis=0) for partition in partitions]
    assert all(len(color_rows) == 1 for color_rows in partition_color_rows)
    assert len(np.unique(np.concatenate(partition_color_rows), axis=0)) == len(partitions)
