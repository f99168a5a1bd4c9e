# SPDX-License-Identifier: GPL-3.0-or-later
"""Patches of partitions: their vertices, the changes of their residuals, and the joints near them."""

import numpy as np
import pytest

from fdda_addon.core.patches import divide_into_patches, largest_norms

from .limb import VERTEX_COUNT, make_rig, partitions_of


@pytest.mark.parametrize("max_vertices", [1, 3, 1000])
def test_each_patch_is_a_small_part_of_one_partition(max_vertices):
    rig = make_rig()
    partitions = partitions_of(rig)
    patches = divide_into_patches(rig, partitions, max_vertices)
    assert sorted(patches.vertices.tolist()) == list(range(VERTEX_COUNT))
    assert np.diff(np.append(patches.starts, VERTEX_COUNT)).max() <= max_vertices
    ends = np.append(patches.starts, VERTEX_COUNT)[[*patches.partition_starts[1:], -1]]
    vertices_of_partitions = np.split(patches.vertices, ends[:-1])
    for partition, vertices in zip(partitions, vertices_of_partitions, strict=True):
        assert sorted(vertices.tolist()) == partition.vertices.tolist()


def test_changes_are_the_largest_norms_in_each_patch():
    rig = make_rig()
    partitions = partitions_of(rig)
    patches = divide_into_patches(rig, partitions, 1000)
    changes = np.zeros((2, VERTEX_COUNT, 3), np.float32)
    changes[1, partitions[1].vertices[2]] += (0.3, 0, -0.4)
    changes[0, partitions[1].vertices[0]] += (0.1, 0, 0)
    changes[0, partitions[3].vertices[-1]] += (0, 0.25, 0)
    expected = np.array([[0, 0.1, 0, 0.25], [0, 0.5, 0, 0]])
    sorted_changes = patches.sort(changes)
    np.testing.assert_allclose(largest_norms(sorted_changes, patches.starts), expected, atol=1e-6)
    vertices, starts = patches.select(np.array([1, 3]))
    np.testing.assert_allclose(largest_norms(sorted_changes[:, vertices], starts), expected[:, [1, 3]], atol=1e-6)


@pytest.mark.parametrize("max_vertices", [1, 3, 1000])
def test_patches_know_their_partitions(max_vertices):
    rig = make_rig()
    partitions = partitions_of(rig)
    patches = divide_into_patches(rig, partitions, max_vertices)
    values = np.zeros((len(partitions), len(patches.starts)), bool)
    for number, partition in enumerate(partitions):
        values[
            number,
            np.searchsorted(patches.starts, np.flatnonzero(patches.vertices == partition.vertices[-1])[0], side="right")
            - 1,
        ] = True
    assert np.array_equal(patches.any_of_partition(values), np.eye(len(partitions), dtype=bool))
    assert patches.partition_of_patch[values.argmax(axis=1)].tolist() == list(range(len(partitions)))


def test_joints_are_nearby_by_weights_on_the_patch_and_its_neighbors():
    rig = make_rig()
    patches = divide_into_patches(rig, partitions_of(rig), 1)
    neighbors = np.eye(VERTEX_COUNT, dtype=bool)
    for face in np.split(rig.face_vertices, rig.face_starts[1:]):
        for first, second in zip(face, np.roll(face, 1), strict=True):
            neighbors[first, second] = neighbors[second, first] = True
    expected = np.zeros((len(rig.joints), len(patches.starts)), bool)
    for patch, vertices in enumerate(np.split(patches.vertices, patches.starts[1:])):
        near = np.flatnonzero(neighbors[vertices].any(axis=0))
        expected[np.unique(rig.skin_joints[near][rig.skin_weights[near] > 0]), patch] = True
    assert expected.any() and not expected.all()
    assert np.array_equal(patches.nearby_joints(rig), expected)
