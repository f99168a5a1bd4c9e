# SPDX-License-Identifier: GPL-3.0-or-later
"""Partitions with too few vertices for a network are merged into other partitions."""

import numpy as np
import pytest

from fdda_addon.core.mathematics.partition import main_joints, make_partitions, small_partition_merges
from fdda_addon.core.rig import STATIC_JOINT, Fingerprint, Joint, MeshPart, Rig


def make_weighted_rig(
    parents: list[int], vertices: list[tuple[dict[int, float], int]], names: list[str] | None = None
) -> Rig:
    """Return a rig of joints with these parents."""
    vertex_weights = [weights for weights, count in vertices for _ in range(count)]
    skin_joints, skin_weights = (
        np.zeros((len(vertex_weights), 4), np.int32),
        np.zeros((len(vertex_weights), 4), np.float32),
    )
    for vertex, weights in enumerate(vertex_weights):
        skin_joints[vertex, : len(weights)], skin_weights[vertex, : len(weights)] = (
            list(weights),
            list(weights.values()),
        )
    joints = tuple(Joint(names[j] if names else f"joint_{j}", parent) for j, parent in enumerate(parents))
    rest_matrices = np.tile(np.eye(4, dtype=np.float32), (len(parents), 1, 1))
    positions = np.random.default_rng(0).normal(size=(len(vertex_weights), 3)).astype(np.float32)
    meshes = (MeshPart("mesh", len(positions), Fingerprint("a", "b", "c")),)
    return Rig(joints, positions, rest_matrices, skin_joints, skin_weights, meshes)


def vertex_counts_after_merging(rig: Rig, min_vertices: int) -> dict[int, int]:
    """Return the number of vertices of each partition, by its joint, after merging the small ones."""
    partitions = make_partitions(rig, merged=small_partition_merges(rig, min_vertices))
    assert sum(len(p.vertices) for p in partitions) == rig.vertex_count
    return {p.joint: len(p.vertices) for p in partitions}


def test_small_partitions_merge_into_the_joint_with_the_next_largest_weight():
    rig = make_weighted_rig([-1, 0, 1, 1], [({0: 1}, 20), ({1: 1}, 20), ({2: 0.5, 3: 0.3, 1: 0.2}, 3), ({3: 1}, 20)])
    assert small_partition_merges(rig, 8) == {2: 3}
    # The weights are summed over all vertices of the partition.
    rig = make_weighted_rig(
        [-1, 0, 1, 1], [({1: 1}, 20), ({2: 0.6, 3: 0.4}, 1), ({2: 0.6, 1: 0.3, 3: 0.1}, 3), ({3: 1}, 20)]
    )
    assert small_partition_merges(rig, 8) == {2: 1}


def test_partitions_with_enough_vertices_are_not_merged():
    rig = make_weighted_rig([-1, 0], [({0: 1}, 20), ({1: 1}, 8)])
    assert small_partition_merges(rig, 8) == {} and small_partition_merges(rig, 9) == {1: 0}
    assert small_partition_merges(rig, 0) == {}
    assert small_partition_merges(rig) == {}


@pytest.mark.parametrize(
    ("vertices", "expected"),
    [
        ([({0: 1}, 20), ({3: 1}, 2)], {3: 0}),
        ([({0: 1}, 20), ({1: 1}, 20), ({3: 1}, 2)], {3: 1}),
        ([({1: 1}, 2), ({3: 1}, 20), ({4: 1}, 20)], {1: 4}),
        # The descendant is three joints away, the ancestor one.
        ([({0: 1}, 20), ({1: 1}, 2), ({5: 1}, 20)], {1: 0}),
        # Without an ancestor or descendant that has vertices, the partition is not merged.
        ([({3: 1}, 20), ({4: 1}, 2)], {}),
    ],
)
def test_without_other_weights_partitions_merge_into_a_relative(vertices, expected):
    assert small_partition_merges(make_weighted_rig([-1, 0, 1, 2, 1, 4], vertices), 8) == expected


def test_chains_of_merges_end_in_a_large_partition():
    rig = make_weighted_rig(
        [-1, 0, 1, 2], [({0: 1}, 20), ({1: 0.7, 0: 0.3}, 3), ({2: 0.7, 1: 0.3}, 2), ({3: 0.7, 2: 0.3}, 1)]
    )
    assert small_partition_merges(rig, 8) == {1: 0, 2: 0, 3: 0}
    partitions = make_partitions(rig, merged=small_partition_merges(rig, 8))
    assert [(p.joint, p.merged, len(p.vertices)) for p in partitions] == [(0, (1, 2, 3), 26)]


def test_small_partitions_that_are_large_together_are_merged_with_each_other():
    rig = make_weighted_rig([-1, 0, 1, 2], [({0: 1}, 20), ({1: 0.9, 2: 0.1}, 5), ({2: 0.9, 1: 0.1}, 4), ({3: 1}, 20)])
    assert small_partition_merges(rig, 8) == {2: 1}
    assert vertex_counts_after_merging(rig, 8) == {0: 20, 1: 9, 3: 20}


def test_one_partition_remains_if_all_are_small():
    rig = make_weighted_rig([-1, 0, 1], [({0: 1}, 2), ({1: 1}, 3), ({2: 1}, 1)])
    assert vertex_counts_after_merging(rig, 100) == {1: 6}


def test_vertices_without_a_bone_are_not_merged():
    rig = make_weighted_rig([-1, 0, -1], [({0: 1}, 20), ({1: 1}, 20), ({2: 1}, 3)], ["a", "b", STATIC_JOINT])
    assert small_partition_merges(rig, 8) == {}


@pytest.mark.parametrize("seed", range(20))
def test_every_merge_ends_in_a_partition_that_remains(seed):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 40))
    parents = [-1, *(int(rng.integers(0, joint)) for joint in range(1, count))]
    vertices = []
    for _ in range(60):
        joints = rng.permutation(count)[: rng.integers(1, min(count, 4) + 1)]
        weights = rng.dirichlet(np.ones(len(joints)))
        vertices.append((dict(zip(joints.tolist(), weights.tolist(), strict=True)), int(rng.integers(1, 12))))
    rig = make_weighted_rig(parents, vertices)
    merges = small_partition_merges(rig, 12)
    assert not set(merges) & set(merges.values())
    remaining_joints = {p.joint for p in make_partitions(rig)} - set(merges)
    assert set(merges.values()) <= remaining_joints and remaining_joints
    vertex_counts = vertex_counts_after_merging(rig, 12)
    assert set(vertex_counts) == remaining_joints
    # A partition that is still small shares no vertex with another partition.
    for joint in (j for j, vertex_count in vertex_counts.items() if vertex_count < 12):
        is_in_partition = main_joints(rig.skin_joints, rig.skin_weights) == joint
        weighted_joints = set(rig.skin_joints[is_in_partition][rig.skin_weights[is_in_partition] > 0].tolist()) - {
            joint
        }
        assert not weighted_joints & remaining_joints
