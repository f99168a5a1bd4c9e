# SPDX-License-Identifier: GPL-3.0-or-later
"""Which partitions take the vertices of those that are too small for a network of their own."""

import numpy as np
import pytest

from fdda_addon.core.partition import main_joints, make_partitions, small_partition_merges
from fdda_addon.core.rig import STATIC_JOINT, Fingerprint, Joint, Rig


def rig_of(parents: list[int], vertices: list[tuple[dict[int, float], int]], names: list[str] | None = None) -> Rig:
    """A rig of joints with these parents, and of so many vertices with each of some weights."""
    rows = [weights for weights, count in vertices for _ in range(count)]
    skin_joints, skin_weights = np.zeros((len(rows), 4), np.int32), np.zeros((len(rows), 4), np.float32)
    for row, weights in enumerate(rows):
        skin_joints[row, : len(weights)], skin_weights[row, : len(weights)] = list(weights), list(weights.values())
    joints = tuple(Joint(names[j] if names else f"joint_{j}", parent) for j, parent in enumerate(parents))
    rest = np.tile(np.eye(4, dtype=np.float32), (len(parents), 1, 1))
    positions = np.random.default_rng(0).normal(size=(len(rows), 3)).astype(np.float32)
    return Rig(joints, positions, rest, skin_joints, skin_weights, Fingerprint("a", "b", "c"))


def merged_sizes(rig: Rig, least: int) -> dict[int, int]:
    """Vertices of each partition after merging."""
    partitions = make_partitions(rig, merged=small_partition_merges(rig, least))
    assert sum(len(p.vertices) for p in partitions) == rig.vertex_count
    return {p.joint: len(p.vertices) for p in partitions}


def test_the_heaviest_other_joint_takes_the_vertices():
    rig = rig_of([-1, 0, 1, 1], [({0: 1}, 20), ({1: 1}, 20), ({2: 0.5, 3: 0.3, 1: 0.2}, 3), ({3: 1}, 20)])
    assert small_partition_merges(rig, 8) == {2: 3}
    # Summed over the vertices, not by vertex.
    rig = rig_of([-1, 0, 1, 1], [({1: 1}, 20), ({2: 0.6, 3: 0.4}, 1), ({2: 0.6, 1: 0.3, 3: 0.1}, 3), ({3: 1}, 20)])
    assert small_partition_merges(rig, 8) == {2: 1}


def test_enough_vertices_stay():
    rig = rig_of([-1, 0], [({0: 1}, 20), ({1: 1}, 8)])
    assert small_partition_merges(rig, 8) == {} and small_partition_merges(rig, 9) == {1: 0}
    assert small_partition_merges(rig, 0) == {}
    assert small_partition_merges(rig) == {}


@pytest.mark.parametrize(
    ("vertices", "expected"),
    [
        ([({0: 1}, 20), ({3: 1}, 2)], {3: 0}),
        ([({0: 1}, 20), ({1: 1}, 20), ({3: 1}, 2)], {3: 1}),
        ([({1: 1}, 2), ({3: 1}, 20), ({4: 1}, 20)], {1: 4}),
        # Three down, one up.
        ([({0: 1}, 20), ({1: 1}, 2), ({5: 1}, 20)], {1: 0}),
        # Neither above nor below: it stays.
        ([({3: 1}, 20), ({4: 1}, 2)], {}),
    ],
)
def test_without_other_weights_the_nearest_ancestor_or_descendant_does(vertices, expected):
    assert small_partition_merges(rig_of([-1, 0, 1, 2, 1, 4], vertices), 8) == expected


def test_chains_end_where_the_vertices_are():
    rig = rig_of([-1, 0, 1, 2], [({0: 1}, 20), ({1: 0.7, 0: 0.3}, 3), ({2: 0.7, 1: 0.3}, 2), ({3: 0.7, 2: 0.3}, 1)])
    assert small_partition_merges(rig, 8) == {1: 0, 2: 0, 3: 0}
    partitions = make_partitions(rig, merged=small_partition_merges(rig, 8))
    assert [(p.joint, p.merged, len(p.vertices)) for p in partitions] == [(0, (1, 2, 3), 26)]


def test_small_ones_that_are_enough_together_stay_together():
    rig = rig_of([-1, 0, 1, 2], [({0: 1}, 20), ({1: 0.9, 2: 0.1}, 5), ({2: 0.9, 1: 0.1}, 4), ({3: 1}, 20)])
    assert small_partition_merges(rig, 8) == {2: 1}
    assert merged_sizes(rig, 8) == {0: 20, 1: 9, 3: 20}


def test_one_partition_is_left():
    rig = rig_of([-1, 0, 1], [({0: 1}, 2), ({1: 1}, 3), ({2: 1}, 1)])
    assert merged_sizes(rig, 100) == {1: 6}


def test_vertices_without_a_bone_stay_by_themselves():
    rig = rig_of([-1, 0, -1], [({0: 1}, 20), ({1: 1}, 20), ({2: 1}, 3)], ["a", "b", STATIC_JOINT])
    assert small_partition_merges(rig, 8) == {}


@pytest.mark.parametrize("seed", range(20))
def test_every_merge_leads_to_a_partition(seed):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 40))
    parents = [-1, *(int(rng.integers(0, joint)) for joint in range(1, count))]
    vertices = []
    for _ in range(60):
        joints = rng.permutation(count)[: rng.integers(1, min(count, 4) + 1)]
        weights = rng.dirichlet(np.ones(len(joints)))
        vertices.append((dict(zip(joints.tolist(), weights.tolist(), strict=True)), int(rng.integers(1, 12))))
    rig = rig_of(parents, vertices)
    merges = small_partition_merges(rig, 12)
    assert not set(merges) & set(merges.values())
    left = {p.joint for p in make_partitions(rig)} - set(merges)
    assert set(merges.values()) <= left and left
    sizes = merged_sizes(rig, 12)
    assert set(sizes) == left
    # What is still small has no relation to any other.
    for joint in (j for j, size in sizes.items() if size < 12):
        own = main_joints(rig.skin_joints, rig.skin_weights) == joint
        related = set(rig.skin_joints[own][rig.skin_weights[own] > 0].tolist()) - {joint}
        assert not related & left
