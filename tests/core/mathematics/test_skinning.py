# SPDX-License-Identifier: GPL-3.0-or-later
"""Linear skinning, joint features, rotations, reference joints and error statistics."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from fdda_addon.core.errors import RigError
from fdda_addon.core.mathematics.features import joint_features, joint_features_in_metres
from fdda_addon.core.mathematics.metrics import (
    NO_ERROR_COLOR,
    error_statistics,
    heat_colors,
    viewport_colors,
    worst_poses,
)
from fdda_addon.core.mathematics.references import choose_references, has_reference_choice, minimum_arborescence
from fdda_addon.core.mathematics.rotations import rotation_vectors
from fdda_addon.core.mathematics.skinning import LinearSkinning, SkinBlock
from fdda_addon.core.rig import STATIC_JOINT, Joint, Rig, read_joints

from ..limb import (
    JOINTS,
    VERTEX_COUNT,
    make_rig,
    partitions_of,
    random_poses,
    random_positions,
    random_rotations,
    random_transforms,
)


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


def reference_features(pose: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Compute (J, 12) features of one pose joint by joint: (B_p^-1 B_j)^-1 P_p^-1 P_j."""
    feature_rows = []
    for joint_index, joint in enumerate(JOINTS):
        parent_pose, parent_rest = (
            (np.eye(4), np.eye(4)) if joint.parent < 0 else (pose[joint.parent], rest[joint.parent])
        )
        rest_relative = np.linalg.inv(parent_rest) @ rest[joint_index]
        feature_rows.append(
            (np.linalg.inv(rest_relative) @ np.linalg.inv(parent_pose) @ pose[joint_index])[:3].reshape(12)
        )
    return np.array(feature_rows)


def test_features_equal_the_formula():
    rig, poses = make_rig(), random_poses(8)
    features = joint_features(poses, rig.rest_matrices, rig.parents)
    for pose, pose_features in zip(poses.astype(np.float64), features, strict=True):
        np.testing.assert_allclose(
            pose_features, reference_features(pose, rig.rest_matrices.astype(np.float64)), atol=1e-5
        )


def test_translations_are_in_metres():
    rig, poses = replace(make_rig(), metres_per_unit=0.01), random_poses(8)
    scale = np.where(np.arange(12) % 4 == 3, 0.01, 1)
    expected = joint_features(poses, rig.rest_matrices, rig.parents) * scale
    np.testing.assert_allclose(joint_features_in_metres(poses, rig), expected, atol=1e-6)


def test_rounding_does_not_change_features():
    """The whole character moves 100 m from the origin; each joint keeps its transform relative to its parent."""
    rig, rng = make_rig(), np.random.default_rng(5)
    motions = np.array([random_transforms(rng) for _ in range(8)])
    motions[:, :3, 3] += 100
    poses = (motions[:, None] @ rig.rest_matrices).astype(np.float32)
    assert np.ptp(joint_features(poses, rig.rest_matrices, rig.parents)[:, 1:, 3::4], axis=0).max() > 0
    assert np.ptp(joint_features_in_metres(poses, rig)[:, 1:, 3::4], axis=0).max() == 0


def axis_quaternions(axis: int, angles: np.ndarray) -> np.ndarray:
    """Return (F, 4) quaternions of rotations about one axis; every second quaternion is negated."""
    quaternions = np.zeros((len(angles), 4))
    quaternions[:, 0], quaternions[:, 1 + axis] = np.cos(angles / 2), np.sin(angles / 2)
    quaternions[::2] *= -1
    return quaternions


def quaternions_from_vectors(vectors: np.ndarray) -> np.ndarray:
    """Return the (F, 4) quaternions of (F, 3) rotation vectors."""
    angles = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.hstack([np.cos(angles / 2), vectors * np.sinc(angles / 2 / np.pi) / 2])


def random_quaternions() -> np.ndarray:
    """Return (500, 4) random quaternions that are not normalized."""
    return np.random.default_rng(0).standard_normal((500, 4))


@pytest.mark.parametrize("quaternions", [random_quaternions(), axis_quaternions(0, np.linspace(-9, 9, 50))])
def test_vectors_represent_the_rotations_of_the_quaternions(quaternions):
    unit_quaternions = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    found = quaternions_from_vectors(rotation_vectors(quaternions))
    np.testing.assert_allclose(np.abs((found * unit_quaternions).sum(axis=1)), 1, atol=1e-12)


@pytest.mark.parametrize("low, high", [(-1, 1), (0, 4.5), (2.5, 4), (-4, -3)])
def test_a_range_about_one_axis_has_the_width_of_the_motion(low, high):
    values = rotation_vectors(axis_quaternions(2, np.linspace(low, high, 40)))
    assert np.ptp(values, axis=0).sum() == pytest.approx(high - low)


def test_a_quaternion_without_length_does_not_rotate():
    assert not rotation_vectors(np.zeros((2, 4))).any()


POSES = 16

NONE_FIXED = np.zeros(4, bool)


def chain_poses(rig: Rig, parents: list[int]) -> np.ndarray:
    """Return (N, J, 4, 4) poses in which joints rotate by about 20 degrees relative to `parents`; -1: it travels."""
    rng, poses = np.random.default_rng(1), np.empty((POSES, len(parents), 4, 4))
    rest = rig.rest_matrices.astype(np.float64)
    for joint in sorted(range(len(parents)), key=lambda joint: (parents[joint] >= 0, parents[joint])):
        carrier = random_transforms(rng, POSES) if parents[joint] < 0 else poses[:, parents[joint]]
        carrier_rest = np.eye(4) if parents[joint] < 0 else rest[parents[joint]]
        u, _, v = np.linalg.svd(np.eye(3) + 0.2 * random_rotations(rng, POSES))
        rotations = np.zeros((POSES, 4, 4))
        rotations[:, :3, :3], rotations[:, 3, 3] = u @ v, 1
        poses[:, joint] = carrier @ np.linalg.inv(carrier_rest) @ rest[joint] @ rotations
    return poses.astype(np.float32)


@pytest.mark.parametrize(
    ("parents", "references"),
    [
        ((-1, -1, -1, -1), (-1, 0, 1, 1)),  # each joint copies a bone of a chain with a branch
        ((-1, 0, -1, 2), (-1, 0, 1, 2)),  # two chains
        ((-1, -1, 1, 1), (-1, 0, 1, 1)),  # a second root with two children
    ],
)
def test_roots_refer_to_the_joints_with_which_they_move(parents: tuple[int, ...], references: tuple[int, ...]):
    rig = replace(make_rig(), joints=tuple(Joint(j.name, p) for j, p in zip(JOINTS, parents, strict=True)))
    poses = chain_poses(rig, [-1, 0, 1, 2 if parents[3] == 2 else 1])
    assert has_reference_choice(rig, NONE_FIXED)
    chosen = choose_references(rig, NONE_FIXED, poses)
    # Any joint may carry the others.
    features = joint_features(poses, chosen.rest_matrices, chosen.references)
    moved = joint_features(random_transforms(np.random.default_rng(2)) @ poses, rig.rest_matrices, chosen.references)
    assert (np.abs(moved - features).max(axis=(0, 2)) > 0.1).sum() == 1
    pairs = {frozenset(pair) for pair in enumerate(chosen.references.tolist()) if pair[1] >= 0}
    assert pairs == {frozenset(pair) for pair in enumerate(references) if pair[1] >= 0}
    assert read_joints([joint.to_json() for joint in chosen.joints]) == chosen.joints == rig.joints


def test_children_of_an_idle_joint_without_weights_refer_to_each_other():
    rig = make_rig()
    joints = (Joint("idle", -1), *(Joint(joint.name, 0) for joint in JOINTS))
    matrices = np.concatenate([np.eye(4, dtype=np.float32)[None], rig.rest_matrices])
    poses = chain_poses(rig, [-1, 0, 1, 1])
    poses = np.concatenate([np.tile(np.eye(4, dtype=np.float32), (POSES, 1, 1, 1)), poses], axis=1)
    flat = replace(rig, joints=joints, rest_matrices=matrices, skin_joints=rig.skin_joints + 1)
    references = choose_references(flat, np.zeros(5, bool), poses).references.tolist()
    assert sorted(references)[:2] == [-1, 0] and references.count(0) == 1


def test_other_rigs_keep_their_parents():
    rig = make_rig()
    with_static_joint = replace(rig, joints=(*rig.joints, Joint(STATIC_JOINT, -1)))
    assert not has_reference_choice(rig, NONE_FIXED) and not has_reference_choice(with_static_joint, np.zeros(5, bool))
    roots = replace(rig, joints=tuple(Joint(joint.name, -1) for joint in JOINTS))
    flattened = chain_poses(roots, [-1, 0, 1, 1])
    flattened[:, 1] = 0
    assert choose_references(roots, NONE_FIXED, flattened).references.tolist() == [-1] * 4
    poses, is_fixed = chain_poses(roots, [-1, 0, 1, 1]), np.array([False, True, False, True])
    assert (choose_references(roots, is_fixed, poses).references[is_fixed] == -1).all()


@pytest.mark.parametrize("references", [(1, 0), (0, None), (2, None)])
def test_invalid_reference_joints_are_refused(references: tuple[object, ...]):
    values = [{"name": str(index), "parent": -1, "reference": r} for index, r in enumerate(references)]
    with pytest.raises(ValueError, match="reference"):
        read_joints(values)


@pytest.mark.parametrize("seed", range(20))
def test_an_arborescence_has_the_smallest_sum_of_costs(seed: int):
    rng = np.random.default_rng(seed)
    costs = np.round(rng.uniform(0, 1, (5, 5)), 1 + seed % 2)
    costs[rng.random((5, 5)) < 0.2] = np.inf
    costs[:, 0], costs[0, 1:] = np.inf, np.minimum(costs[0, 1:], 2.0)

    def cost_of(sources: tuple[int, ...]) -> float:
        for node in range(1, 5):
            path = [node]
            while (node := sources[node]) > 0:
                if node in path:
                    return np.inf
                path.append(node)
        return sum(costs[sources[node], node] for node in range(1, 5) if node != sources[node])

    best = min(cost_of((-1, *others)) for others in product(range(5), repeat=4))
    sources = minimum_arborescence(costs)
    assert sources[0] == -1
    assert np.isclose(cost_of(tuple(sources.tolist())), best)


def test_statistics_are_in_millimeters():
    errors = np.linspace(0, 0.010, 10_001).reshape(73, 137)
    statistics = error_statistics(errors)
    assert statistics.mean == pytest.approx(5.0)
    assert statistics.rms == pytest.approx(10 / 3**0.5, rel=1e-3)
    assert (statistics.p99, statistics.p999, statistics.max) == pytest.approx((9.9, 9.99, 10.0))
    assert list(statistics.to_json()) == ["mean", "rms", "p99", "p999", "max"]


def test_heat_colors_are_green_without_an_error_then_blue_violet_and_red():
    colors = heat_colors(np.array([0.9e-6, 1e-6, 0.005, 0.010, 3.0]))
    blue, violet, red = (0.10, 0.25, 0.95), (0.60, 0.10, 0.80), (0.95, 0.05, 0.05)
    np.testing.assert_allclose(colors, [NO_ERROR_COLOR, blue, violet, red, red], atol=1e-5)
    np.testing.assert_allclose(heat_colors(np.array([0.0005]), 0.001), [violet], atol=1e-5)


def test_worst_poses_keep_a_distance_and_are_sorted():
    errors = np.zeros((12, 3))
    errors[[2, 3, 7, 11], [0, 1, 2, 0]] = 0.01, 0.03, 0.02, 1e-9
    assert worst_poses(errors, 5, 2) == [3, 7]
    assert worst_poses(errors, 5, 1) == [3, 7, 2]
    assert worst_poses(errors, 1, 1) == [3]
    assert worst_poses(np.zeros((4, 2)), 3, 1) == []


def test_viewport_colors_are_those_of_weight_paint():
    colors = viewport_colors(np.array([0.0, 0.0025, 0.005, 0.0075, 0.01, 1.0]), 0.01)
    blue, cyan, green, yellow, red = (0, 0, 1), (0, 1, 1), (0, 1, 0), (1, 1, 0), (1, 0, 0)
    np.testing.assert_allclose(colors, [blue, cyan, green, yellow, red, red], atol=1e-6)
    assert colors.dtype == np.float32
