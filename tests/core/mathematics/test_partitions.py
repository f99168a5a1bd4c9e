# SPDX-License-Identifier: GPL-3.0-or-later
"""Partitions: their vertices and influences, small ones that are merged, and masks."""

from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.mathematics.mask import Mask, SkinningBlend
from fdda_addon.core.mathematics.partition import (
    assume_nearby_influences,
    main_joints,
    make_partitions,
    partition_colors,
    small_partition_merges,
)
from fdda_addon.core.mathematics.skinning import LinearSkinning
from fdda_addon.core.rig import STATIC_JOINT, Fingerprint, Joint, MeshPart, Rig

from ..limb import INFLUENCING, VERTEX_COUNT, make_rig, partitions_of, random_poses


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


MASK_WEIGHTS = np.linspace(0, 1, VERTEX_COUNT).astype(np.float32)


@pytest.fixture(scope="module")
def rig():
    """The rig of the limb."""
    return make_rig()


@pytest.fixture
def positions() -> np.ndarray:
    """Positions of a model's output in five poses."""
    return np.random.default_rng(3).uniform(-1, 1, (5, VERTEX_COUNT, 3)).astype(np.float32)


@pytest.mark.parametrize(
    "weights", [None, MASK_WEIGHTS, np.zeros(VERTEX_COUNT), np.ones(VERTEX_COUNT), (MASK_WEIGHTS > 0.5) * 1.0]
)
@pytest.mark.parametrize("strengths", [[1, 1, 1, 1, 1], [0, 0, 0, 0, 0], [0, 0.25, 0.5, 1, 1]])
def test_positions_are_blended_by_strength_times_weight(rig, positions, weights, strengths):
    poses, strengths = random_poses(5), np.float32(strengths)
    linear_positions = LinearSkinning(rig).positions(poses)
    vertex_weights = np.ones(VERTEX_COUNT) if weights is None else weights
    expected = linear_positions + (strengths[:, None] * vertex_weights)[..., None] * (positions - linear_positions)
    blend = SkinningBlend(rig, None if weights is None else Mask.from_weights(weights))
    blended = blend.apply(positions.copy(), poses, strengths)
    np.testing.assert_allclose(blended, expected, atol=1e-6)
    assert blended.dtype == np.float32
    if weights is not None and strengths.min() == 1:
        np.testing.assert_allclose(
            Mask.from_weights(weights).blend(linear_positions[0], positions[0]), expected[0], atol=1e-6
        )


def test_positions_with_strength_zero_may_be_invalid(rig, positions):
    """With strength 0 the model does not run, so its output buffer may contain any values."""
    positions[0] = np.nan
    assert np.isfinite(SkinningBlend(rig).apply(positions, random_poses(5), np.float32([0, 1, 0.5, 1, 1]))).all()


def test_with_mask_replaces_the_mask(rig, positions):
    poses, full_strengths = random_poses(5), np.ones(5, np.float32)
    blend = SkinningBlend(rig, Mask.from_weights(MASK_WEIGHTS))
    blend.apply(positions.copy(), poses, full_strengths)
    replaced = blend.with_mask(Mask.from_weights(1 - MASK_WEIGHTS))
    expected = SkinningBlend(rig, Mask.from_weights(1 - MASK_WEIGHTS)).apply(positions.copy(), poses, full_strengths)
    assert (replaced.apply(positions.copy(), poses, full_strengths) == expected).all()
    assert (blend.with_mask(None).apply(positions.copy(), poses, full_strengths) == positions).all()


def test_weights_are_clamped_to_zero_and_one():
    mask = Mask.from_weights([-1, 0.5, 3])
    assert mask.weights.tolist() == [0, 0.5, 1] and mask.partial_vertices.tolist() == [0, 1]
    assert mask == Mask.from_weights([0, 0.5, 1]) and mask != Mask.from_weights([0, 0.5, 0.5])
