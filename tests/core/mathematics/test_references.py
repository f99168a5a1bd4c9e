# SPDX-License-Identifier: GPL-3.0-or-later
"""Reference joints follow from the poses, where parents do not show what moves a joint."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from fdda_addon.core.mathematics.features import joint_features
from fdda_addon.core.mathematics.references import choose_references, has_reference_choice, minimum_arborescence
from fdda_addon.core.rig import STATIC_JOINT, Joint, Rig, read_joints

from ..limb import JOINTS, make_rig, random_rotations, random_transforms

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
