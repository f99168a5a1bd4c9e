# SPDX-License-Identifier: GPL-3.0-or-later
"""Chooses reference joints: the joints relative to which the transforms of other joints are inputs.

The reference joint of a joint is its parent where the parent moves it. In game rigs each deforming bone is a root, or a
child of one idle bone, and copies a control bone; a prop has a root of its own. The transforms of such joints relative
to their parents contain the motion of the whole character, which deforms nothing. So their reference joints are those
relative to which they move least in the recorded poses. One root remains relative to mesh-object space.
"""

from dataclasses import replace

import numpy as np

from ..rig import STATIC_JOINT, Rig
from .skinning import are_invertible, skin_matrices

LENGTH_RATIO = 0.05
"""Distance from the head of a joint to the points whose motion is measured, as a part of the character's size."""
PARENT_RATIO = 0.5
"""A joint keeps its parent unless its motion relative to another joint is smaller than this part of that relative to
its parent."""
DISTANCE_RATIO = 1e-3
"""Motion that a distance in the rest pose counts as, so that of equal candidates the nearest joint is chosen."""


def has_reference_choice(rig: Rig, is_fixed: np.ndarray) -> bool:
    """Return whether a joint of a rig may have another reference joint than its parent; as `choose_references`."""
    is_candidate, children = _find_candidates(rig, is_fixed), np.flatnonzero(rig.parents >= 0)
    is_candidate[rig.parents[children], children] = False
    return bool(is_candidate.any())


def choose_references(rig: Rig, is_fixed: np.ndarray, pose_matrices: np.ndarray) -> Rig:
    """Return a rig with the reference joints of its joints.

    Args:
        rig: the rig with the skin weights of linear skinning.
        is_fixed: (J,) bool, joints that keep their parents as reference joints.
        pose_matrices: (N, J, 4, 4) recorded poses, mesh-object space, mesh units. Poses in which a joint has a scale of
            zero are ignored; without others, the reference joints are the parents.
    """
    pose_matrices = pose_matrices[are_invertible(pose_matrices).all(axis=1)]
    is_candidate, parents = _find_candidates(rig, is_fixed), rig.parents
    if not len(pose_matrices) or not is_candidate.any():
        return rig
    # A joint that keeps its parent in any case belongs to the node of its parent.
    is_node = is_candidate.any(axis=0) | (parents < 0)
    nodes, owners = np.flatnonzero(is_node), np.cumsum(is_node) - 1
    for joint in np.flatnonzero(~is_node).tolist():
        owners[joint] = owners[parents[joint]]
    skin = skin_matrices(pose_matrices, rig.rest_matrices).astype(np.float64)
    inverse_skin, heads = np.linalg.inv(skin)[:, :, :3], rig.rest_matrices[:, :3, 3].astype(np.float64)
    offsets = LENGTH_RATIO * rig.size * np.eye(3, 4)
    costs, nearest = np.full((len(nodes),) * 2, np.inf), np.full((len(nodes),) * 2, -1)
    for node, joint in enumerate(nodes.tolist()):
        candidates = np.flatnonzero(is_candidate[:, joint])
        points = skin[:, joint] @ np.vstack([heads[joint, :, None] + offsets, np.ones(4)])
        relative = inverse_skin[:, candidates] @ points[:, None]
        motions = np.sqrt(relative.var(axis=0).sum(axis=1).mean(axis=1))
        motions += DISTANCE_RATIO * np.linalg.norm(heads[candidates] - heads[joint], axis=1)
        motions[candidates == parents[joint]] *= PARENT_RATIO
        # The smallest motion is assigned last.
        order = np.argsort(-motions, kind="stable")
        costs[owners[candidates[order]], node] = motions[order]
        nearest[owners[candidates[order]], node] = candidates[order]
    joints = list(rig.joints)
    for node, source in enumerate(minimum_arborescence(costs).tolist()):
        joint = int(nodes[node])
        if source >= 0 and (reference := int(nearest[source, node])) != parents[joint]:
            joints[joint] = replace(joints[joint], reference=reference)
    return replace(rig, joints=tuple(joints))


def _find_candidates(rig: Rig, is_fixed: np.ndarray) -> np.ndarray:
    """Return (J, J) bool: element (i, j) is whether joint i may be the reference joint of joint j.

    A joint may have another reference joint than its parent if none of its ancestors has skin weights. That joint has
    skin weights, because influences and linear fits follow from such joints. The root with most weighted descendants
    keeps mesh-object space.
    """
    parents, joint_count = rig.parents, len(rig.joints)
    weights = np.bincount(rig.skin_joints.ravel(), rig.skin_weights.ravel(), joint_count)
    is_static = np.array([name == STATIC_JOINT for name in rig.joint_names])
    is_weighted, is_free = (weights > 0) & ~is_static, ~is_static
    is_descendant = np.eye(joint_count, dtype=bool)
    for joint, parent in enumerate(parents.tolist()):
        if parent >= 0:
            is_free[joint] = is_free[parent] and not is_weighted[parent]
            is_descendant[:, joint] |= is_descendant[:, parent]
    is_root = (parents < 0) & ~is_static
    counts = np.where(is_root, is_descendant @ is_weighted, -1)
    first = max(range(joint_count), key=lambda joint: (counts[joint], is_descendant[joint] @ weights))
    is_candidate = (is_weighted[:, None] | (np.arange(joint_count)[:, None] == parents)) & is_free
    is_candidate &= ~is_descendant.T & ~is_static[:, None]
    is_candidate[:, is_fixed] = False
    is_candidate[:, first] = False
    return is_candidate


def minimum_arborescence(costs: np.ndarray) -> np.ndarray:
    """Find the spanning arborescence with the smallest sum of costs.

    Reference: Edmonds, Optimum Branchings, 1967.

    Args:
        costs: (n, n), costs of the edges from row to column; infinite where there is none. The nodes without any edge
            to them are roots.

    Returns:
        (n,) node from which an edge leads to each node; -1 for a root.
    """
    count = len(costs)
    costs = np.where(np.eye(count, dtype=bool), np.inf, costs)
    is_root = ~np.isfinite(costs).any(axis=0)
    sources = np.where(is_root, -1, costs.argmin(axis=0))
    labels = np.full(count, -1)
    in_cycle = np.zeros(count, bool)
    for start in range(count):
        path, node = [], start
        while node >= 0 and labels[node] < 0:
            labels[node] = count + start
            path.append(node)
            node = sources[node]
        if node >= 0 and labels[node] == count + start:
            in_cycle[path[path.index(node) :]] = True
    if not in_cycle.any():
        return sources
    # Contract each cycle to one node.
    next_label = 0
    labels = np.full(count, -1)
    for start in range(count):
        node = start
        if labels[start] < 0:
            while labels[node] < 0:
                labels[node] = next_label
                node = sources[node] if in_cycle[node] else node
            next_label += 1
    reduced = costs - np.where(in_cycle, costs[np.maximum(sources, 0), np.arange(count)], 0)
    first, second = np.nonzero(np.isfinite(reduced) & (labels[:, None] != labels))
    order = np.argsort(-reduced[first, second], kind="stable")
    first, second = first[order], second[order]
    contracted = np.full((next_label,) * 2, np.inf)
    edges = np.zeros((next_label, next_label, 2), np.int64)
    # The smallest cost is assigned last.
    contracted[labels[first], labels[second]] = reduced[first, second]
    edges[labels[first], labels[second]] = np.stack([first, second], axis=1)
    for label, source in enumerate(minimum_arborescence(contracted).tolist()):
        if source >= 0:
            source_node, node = edges[source, label]
            sources[node] = source_node
    return sources
