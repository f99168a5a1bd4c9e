# SPDX-License-Identifier: GPL-3.0-or-later
"""Chooses key joints: the joints that a model reads, so that the motion of all others follows from them.

The skin matrix S_r of a joint r moves its vertices relative to another joint a, its anchor, by S_a^-1 S_r. A joint can
be removed if this motion is constant, or if it is a function of the inputs that remain: the transforms of key joints
relative to their parents, and controls. A joint that random poses move by channels of its own is removed only in the
first case. The function is a least-squares fit to half of the poses, and its error is measured on the other half, at
the vertices of the joint. So chance cannot explain a joint that moves independently. Inputs are selected by orthogonal
matching pursuit (Pati et al., 1993), joints are removed greedily.

A root, or a joint that random poses do not move, stays while one of its children does: the features of children are
relative to it, so that they do not change when an animation moves it, as a character walks with its root.
"""

import heapq
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from fdda_addon.core.errors import RecordingError
from fdda_addon.core.mathematics.key_joints import KeyJointReport
from fdda_addon.core.mathematics.partition import joints_with_weight, make_partitions
from fdda_addon.core.mathematics.skinning import are_invertible, skin_matrices
from fdda_addon.core.rig import STATIC_JOINT, reference_order
from fdda_addon.core.settings import AUTO

from ..fits.joint_fit import solve_ridge
from .fit_poses import FitPoses
from .solver import fit_skin

TOLERANCE_RATIO = 1e-4
"""A joint is removed if the motion that remains unexplained is at most this part of the character's size (rms over
poses and vertices, times skin weights). Models have errors of this size."""
MAX_INPUTS = 4
"""Largest number of inputs that explain a joint, besides its anchor."""
MIN_RELATIVE_GAIN = 0.01
"""An input is added only if it lowers the squared error of the fit by this part."""
COST_STEP = 0.1
"""Costs of removals that differ by less count as equal."""
ANCHOR_POSES = 24
"""Number of poses by which the anchor of a joint is chosen."""


BLOCK_COLUMNS = 6
"""Largest number of principal components of the features of an input."""
MIN_SPREAD = 1e-4
"""Principal components with a smaller standard deviation count as constant."""
LENGTH_RATIO = 0.05
"""Length that counts as much as a rotation by one radian, as a part of the character's size."""
MAX_PRODUCT_FACTORS = 7
"""Largest number of columns whose products are added to a fit."""
RIDGE = 1e-3
"""Ridge of a fit, for columns with a variance of 1."""


class InputBlocks:
    """Features of J joints and C controls in n poses.

    The training poses are those with even indices. The columns of a block are uncorrelated there, with mean 0 and
    variance 1. Features of a joint are relative to its nearest ancestor that was not removed, as those of a model.

    Attributes:
        count: J + C; the block of control c is J + c.
        widths: (J + C,) number of columns of each block; 0 if the input does not change.
        parents: (J,) nearest ancestor of each joint that was not removed; -1 if there is none. In this module and in
            `key_joints`, the parent of a joint is its reference joint.
    """

    def __init__(self, poses: FitPoses):
        """Compute the features of poses."""
        self._size, self.parents = max(poses.rig.size, 1e-9), poses.rig.references
        self._poses, self._rest = (
            matrices.astype(np.float64) for matrices in (poses.pose_matrices, poses.rig.rest_matrices)
        )
        self._inverse_poses, self._inverse_rest = np.linalg.inv(self._poses), np.linalg.inv(self._rest)
        joint_count = len(self.parents)
        self.count = joint_count + poses.controls.shape[1]
        self._columns = np.zeros((self.count, BLOCK_COLUMNS, len(self._poses)))
        self.widths = np.zeros(self.count, int)
        for joint in range(joint_count):
            self._set(joint, self._joint_features(joint))
        for block, values in enumerate(poses.controls.T.astype(np.float64), joint_count):
            self._set(block, _standardize(values[:, None]))
        self._is_usable = self.widths > 0

    def _set(self, block: int, features: np.ndarray) -> None:
        # Principal components, with variance 1 in the training poses.
        centered = features - features[::2].mean(axis=0)
        covariance = centered[::2].T @ centered[::2] / len(centered[::2])
        variances, axes = np.linalg.eigh(covariance)
        order = np.argsort(-variances)[:BLOCK_COLUMNS]
        order = order[variances[order] > MIN_SPREAD**2]
        components = centered @ axes[:, order] / np.sqrt(variances[order])
        self.widths[block] = components.shape[1]
        self._columns[block] = 0
        self._columns[block, : components.shape[1]] = components.T

    def _joint_features(self, joint: int) -> np.ndarray:
        """Return (n, 15): transform relative to the parent and the rest pose, lengths as ratios, and half the rotation.

        A joint that follows half of a rotation is a linear function of half-rotation features (docs/method.md).
        """
        parent, matrices, rest = self.parents[joint], self._poses[:, joint], self._rest[joint]
        if parent >= 0:
            matrices, rest = self._inverse_poses[:, parent] @ matrices, self._inverse_rest[parent] @ rest
        relative = (np.linalg.inv(rest) @ matrices)[:, :3]
        relative[..., 3] /= LENGTH_RATIO * self._size
        rotations = relative[..., :3]
        skew = rotations - np.swapaxes(rotations, -1, -2)
        halves = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
        halves /= np.maximum(3 + np.trace(rotations, axis1=1, axis2=2), 0.1)[:, None]
        return np.concatenate([relative.reshape(-1, 12), 2 * halves], axis=1)

    def children(self, joint: int) -> list[int]:
        """Return the joints, removed ones among them, whose features are relative to a joint."""
        return np.flatnonzero(self.parents == joint).tolist()

    def remove(self, joint: int) -> list[int]:
        """Remove a joint, and return its children, whose features are relative to its parent now."""
        self._is_usable[joint] = False
        children = self.children(joint)
        for child in children:
            self.parents[child] = self.parents[joint]
            self._set(child, self._joint_features(child))
        return children

    def restore(self, joint: int, children: list[int]) -> None:
        """Undo `remove`."""
        self._is_usable[joint] = self.widths[joint] > 0
        for child in children:
            self.parents[child] = joint
            self._set(child, self._joint_features(child))

    def best_block(self, remaining: np.ndarray, excluded: tuple[int, ...]) -> int | None:
        """Return the block that explains most of the remaining motion in training poses.

        Args:
            remaining: (n / 2, 12) motion that the used blocks do not explain.
            excluded: blocks to leave out, those that are used already among them.
        """
        is_usable = self._is_usable & (self.widths > 0)
        is_usable[list(excluded)] = False
        if not is_usable.any():
            return None
        gains = ((self._columns[:, :, ::2] @ remaining) ** 2).sum(axis=(1, 2)) / len(remaining)
        # Columns explain a part of any motion by chance, each one n-th.
        gains -= self.widths * (remaining**2).sum() / len(remaining)
        return int(np.where(is_usable, gains, -np.inf).argmax())

    def select(self, blocks: tuple[int, ...]) -> np.ndarray:
        """Return the (n, c) columns of blocks, with the products of the first of each block."""
        columns = np.concatenate([self._columns[block, : self.widths[block]] for block in blocks]).T
        share = max(1, MAX_PRODUCT_FACTORS // len(blocks))
        factors = np.concatenate([self._columns[block, : min(share, self.widths[block])] for block in blocks]).T
        first, second = np.triu_indices(factors.shape[1])
        return np.concatenate([columns, _standardize(factors[:, first] * factors[:, second])], axis=1)


def predict(columns: np.ndarray, motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit the (n / 2, m) motion in training poses by (n, c) columns; return the fit there and in the other poses."""
    training, held_out = columns[::2], columns[1::2]
    coefficients = solve_ridge(training.T @ training, training.T @ motion, RIDGE * len(training))
    return training @ coefficients, held_out @ coefficients


def _standardize(columns: np.ndarray) -> np.ndarray:
    """Return (n, c) columns with mean 0 and variance 1 in the training poses; constant columns become 0."""
    training = columns[::2]
    spread = training.std(axis=0)
    return np.where(spread > 1e-9, (columns - training.mean(axis=0)) / np.maximum(spread, 1e-9), 0)


@dataclass(frozen=True)
class KeyJoints:
    """Key joints of a rig with V vertices, J joints and C controls.

    Attributes:
        joints: (K,) indices of the key joints, ascending.
        weighted_joints: ascending, key joints that may have skin weights; the others are kept for their children alone.
        inputs: (J + C, K + C) bool, the key joints and controls from which the motion of each joint and control of the
            rig follows; of a key joint and a control these are the joint or control itself.
        acts: (V, J) bool, the vertices on which each joint acts that is no key joint.
        report: numbers of joints and errors.
    """

    joints: np.ndarray
    weighted_joints: np.ndarray
    inputs: np.ndarray
    acts: np.ndarray
    report: KeyJointReport


@dataclass(frozen=True)
class _Explanation:
    """How a removed joint follows from others.

    Attributes:
        anchor, inputs: the anchor, and the other inputs that explain the joint.
        unexplained: motion that remains, mesh units.
        cost: `unexplained` relative to the tolerance; the whole motion in place of it for joints that random poses
            move by channels of their own.
    """

    anchor: int
    inputs: tuple[int, ...]
    unexplained: float
    cost: float


def joint_moments(rest_positions: np.ndarray, joints: np.ndarray, weights: np.ndarray, joint_count: int) -> np.ndarray:
    """Compute M_j = sum_v w_vj^3 x_v x_v^T / sum_v w_vj, so that tr(A M_j A^T) is the mean squared motion by A - I.

    A vertex with a small weight moves little and counts little.

    Args:
        rest_positions: (V, 3), mesh units.
        joints, weights: (V, I) joints with skin weights, and the weights.
        joint_count: J.

    Returns:
        (J, 4, 4) float64, square mesh units; 0 for joints without weights.
    """
    points = np.concatenate([rest_positions, np.ones((len(rest_positions), 1))], axis=1).astype(np.float64)
    products = (points[:, :, None] * points[:, None]).reshape(-1, 16)
    moments, weight_sums = np.zeros((joint_count, 16)), np.zeros(joint_count)
    for slot in range(joints.shape[1]):
        slot_weights = weights[:, slot].astype(np.float64)
        np.add.at(moments, joints[:, slot], slot_weights[:, None] ** 3 * products)
        np.add.at(weight_sums, joints[:, slot], slot_weights)
    return (moments / np.maximum(weight_sums, 1e-9)[:, None]).reshape(-1, 4, 4)


class KeyJointSearch:
    """Removes joints greedily, first those that the others explain best."""

    def __init__(
        self, poses: FitPoses, moments: np.ndarray, blocks: InputBlocks, is_static: np.ndarray, is_unseen: np.ndarray
    ):
        """Prepare the search.

        Args:
            poses: n poses of J joints; every other pose measures the errors of the fits.
            moments: (J, 4, 4) moments of the vertices of each joint, square mesh units.
            blocks: features of the joints and controls in these poses.
            is_static: (J,) bool, joints that never move.
            is_unseen: (J,) bool, joints that only actions move. Neither are removed.
        """
        self._size, self._names = max(poses.rig.size, 1e-9), poses.rig.joint_names
        self._tolerance = TOLERANCE_RATIO * self._size
        self._blocks, self._is_kept = blocks, np.ones(len(moments), bool)
        self._is_required = is_static | is_unseen
        self._skin = skin_matrices(poses.pose_matrices, poses.rig.rest_matrices).astype(np.float64)
        self._inverse_skin = np.linalg.inv(self._skin)[:, :, :3]
        variances, axes = np.linalg.eigh(moments)
        self._moment_roots = axes * np.sqrt(np.maximum(variances, 0))[:, None]
        self._is_sampled, self._is_still = poses.is_sampled, blocks.widths[: len(moments)] == 0
        parents = poses.rig.references
        self._ancestors: list[list[int]] = [[] for _ in parents]
        for joint in reference_order(poses.rig.joints):
            if (parent := int(parents[joint])) >= 0:
                self._ancestors[joint] = [parent, *self._ancestors[parent]]
        has_weights = np.zeros(len(moments), bool)
        has_weights[poses.rig.skin_joints[poses.rig.skin_weights > 0]] = True
        is_root = parents < 0
        self._has_own_weights = has_weights | is_root | self._is_required
        self._is_weightless_root = is_root & ~has_weights & ~is_static
        self._is_anchor_of_descendants = self._is_still & ~is_static
        self._anchor_motions = self._measure_anchor_motions()
        self._explanations: dict[int, _Explanation] = {}

    def _measure_anchor_motions(self) -> np.ndarray:
        """Return (J, J) rms motion of each joint at its vertices relative to each other joint, mesh units.

        The motion is infinite relative to joints that are no anchors. A joint that random poses do not move, but an
        animation may, is an anchor of its descendants alone.
        """
        poses = np.linspace(0, len(self._skin) - 1, min(ANCHOR_POSES, len(self._skin))).astype(int)
        inverse_skin, joint_count = self._inverse_skin[poses], self._skin.shape[1]
        motions = np.empty((joint_count, joint_count))
        for joint in range(joint_count):
            relative = inverse_skin @ (self._skin[poses, joint] @ self._moment_roots[joint])[:, None]
            motions[joint] = np.sqrt(relative.var(axis=0).sum(axis=(1, 2)))
            is_ancestor = np.zeros(joint_count, bool)
            is_ancestor[self._ancestors[joint]] = True
            motions[joint, self._is_weightless_root | (self._is_anchor_of_descendants & ~is_ancestor)] = np.inf
            motions[joint, joint] = np.inf
        return motions

    def search(self, count: int | None, on_step: Callable[[int, int], None]) -> None:
        """Remove joints whose unexplained motion is within the tolerance, or until `count` joints are left.

        At least one joint is left besides those that are never removed. `on_step` is called often, with the number of
        decided joints and of those that may be removed; it may raise an exception.
        """
        queue = [self._queue_entry(joint, 0.0) for joint in np.flatnonzero(~self._is_required).tolist()]
        heapq.heapify(queue)
        total = len(queue)
        min_count, waiting = max(count or 1, int(self._is_required.sum()) + 1), set()
        while queue and self._is_kept.sum() > min_count:
            on_step(total - len(queue) - len(waiting), total)
            *_, joint = heapq.heappop(queue)
            if self._carries_children(joint):
                waiting.add(joint)
                continue
            self._is_kept[joint] = False
            children = self._blocks.remove(joint)
            changed = {joint, *children}
            dependents = [
                removed
                for removed, known in self._explanations.items()
                if known.anchor == joint or not changed.isdisjoint(known.inputs)
            ]
            explanations = {removed: self._explain(removed) for removed in (joint, *dependents)}
            cost = max(explanation.cost for explanation in explanations.values())
            is_removable = count is not None or cost <= 1
            entry = self._queue_entry(joint, cost)
            # Removals since the last evaluation may have made this one more expensive than others.
            if is_removable and not (queue and entry > queue[0]):
                self._explanations |= explanations
                parent = int(self._blocks.parents[joint])
                if parent in waiting and not self._carries_children(parent):
                    waiting.remove(parent)
                    heapq.heappush(queue, self._queue_entry(parent, 0.0))
                continue
            self._is_kept[joint] = True
            self._blocks.restore(joint, children)
            if is_removable:
                heapq.heappush(queue, entry)

    @property
    def _may_have_weights(self) -> np.ndarray:
        """Return (J,) bool; the others are kept for their children alone, because they move as their parents do."""
        return self._has_own_weights | (self._blocks.widths[: len(self._ancestors)] > 0)

    def _carries_children(self, joint: int) -> bool:
        """Return whether a joint has children that are kept, and is a root or does not move."""
        if not self._is_still[joint] and self._blocks.parents[joint] >= 0:
            return False
        return bool(self._is_kept[self._blocks.children(joint)].any())

    def _queue_entry(self, joint: int, cost: float) -> tuple:
        """Return the place of a joint in the order of removal.

        Animators pose the joints that random poses move, so those come last. Among joints with nearly equal costs,
        children come first.
        """
        step = int(cost / COST_STEP)
        return cost > 1, bool(self._is_sampled[joint]), step, -len(self._ancestors[joint]), joint

    def _explain(self, joint: int) -> _Explanation:
        """Explain the motion of a joint by kept joints and controls.

        The anchor is the joint with the smallest motion relative to it, or the nearest ancestor.
        """
        is_candidate = self._is_kept & self._may_have_weights
        kept = np.flatnonzero(is_candidate if is_candidate.any() else self._is_kept)
        anchor = int(kept[self._anchor_motions[joint, kept].argmin()])
        best = self._explain_from(joint, anchor)
        ancestor = next((ancestor for ancestor in self._ancestors[joint] if is_candidate[ancestor]), anchor)
        if ancestor == anchor or best.cost <= COST_STEP:
            return best
        return min(best, self._explain_from(joint, ancestor), key=lambda explanation: explanation.cost)

    def _explain_from(self, joint: int, anchor: int) -> _Explanation:
        """Explain the motion of a joint relative to an anchor."""
        moved = self._skin[:, joint] @ self._moment_roots[joint]
        motion = (self._inverse_skin[:, anchor] @ moved).reshape(len(moved), 12)
        motion = motion - motion[::2].mean(axis=0)
        # What moves a root usually moves the whole character, so a root is an input only if no others are enough.
        roots = [kept for kept in np.flatnonzero(self._is_kept).tolist() if self._blocks.parents[kept] < 0]
        inputs, error = self._find_inputs(motion, roots)
        if error > self._tolerance:
            inputs, error = self._find_inputs(motion)
        total = _rms(motion[1::2])
        if self._is_sampled[joint]:
            # Animators pose this joint, so what explains it in these poses may not explain it in others.
            return _Explanation(anchor, inputs, total, total / self._tolerance)
        return _Explanation(anchor, inputs, error, error / self._tolerance)

    def _find_inputs(self, motion: np.ndarray, excluded: Iterable[int] = ()) -> tuple[tuple[int, ...], float]:
        """Find inputs that explain the (n, 12) motion; return them and the rms of the remaining motion, mesh units."""
        training, held_out = motion[::2], motion[1::2]
        inputs: tuple[int, ...] = ()
        best, remaining = (inputs, _rms(held_out)), training
        while len(inputs) < MAX_INPUTS and best[1] > self._tolerance / 4:
            chosen = self._blocks.best_block(remaining, (*inputs, *excluded))
            if chosen is None:
                break
            inputs = (*inputs, chosen)
            fitted, predicted = predict(self._blocks.select(inputs), training)
            gain = 1 - (training - fitted).var() / max(remaining.var(), 1e-30)
            remaining = training - fitted
            if (error := _rms(held_out - predicted)) < best[1]:
                best = inputs, error
            if gain < MIN_RELATIVE_GAIN:
                break
        return best

    def result(self, requested: str, acts: np.ndarray, metres_per_unit: float) -> KeyJoints:
        """Return the joints that are left; `acts` is (V, J) bool, the vertices on which each joint acts."""
        joint_count = len(self._is_kept)
        inputs, unexplained = np.eye(self._blocks.count, dtype=bool), np.zeros(joint_count)
        is_independent = np.zeros(joint_count, bool)
        roots = [joint for joint in np.flatnonzero(self._is_kept).tolist() if self._blocks.parents[joint] < 0]
        differences = np.abs(self._skin[:, roots] - self._skin[:, roots[:1]])
        # What moves all roots moves the whole character, and no residual follows from it.
        free_roots = set(roots) if differences.max() < MIN_SPREAD * max(1.0, self._size) else set()
        for joint, explanation in self._explanations.items():
            inputs[joint, [*({explanation.anchor} - free_roots), *explanation.inputs]] = True
            unexplained[joint], is_independent[joint] = explanation.unexplained, explanation.cost > 1
        joints = np.flatnonzero(self._is_kept)
        weighted_joints = joints[self._may_have_weights[joints]]
        columns = np.append(joints, np.arange(joint_count, self._blocks.count))
        report = KeyJointReport(
            requested,
            len(joints),
            joint_count,
            1000 * metres_per_unit * float(unexplained.max()),
            1000 * metres_per_unit * self._tolerance,
            tuple(self._names[joint] for joint in np.argsort(-unexplained) if is_independent[joint]),
            tuple(self._names[joint] for joint in np.flatnonzero(~self._is_kept & self._is_still)),
        )
        weighted_joints = weighted_joints if len(weighted_joints) else joints
        return KeyJoints(joints, weighted_joints, inputs[:, columns], acts & ~self._is_kept, report)


def _rms(motion: np.ndarray) -> float:
    """Return the root mean square over poses of (n, 12) motions."""
    return float(np.sqrt((motion**2).sum(axis=1).mean()))


MAX_PATCH_VERTICES = 16
"""Largest number of vertices that one fitted vertex represents."""


def choose_key_joints(
    all_poses: FitPoses, requested: str, on_progress: Callable[[int, int], None] = lambda done, total: None
) -> KeyJoints:
    """Choose key joints by random poses.

    Joints that only frames of actions move are kept, because random poses do not show what they would follow from.

    Args:
        all_poses: poses with J joints; random ones, every other of which measures errors, then frames of actions.
        requested: "auto", or the number of key joints.
        on_progress: called often, with the number of decided joints and of those that may be removed.

    Raises:
        RecordingError: a joint has a scale of zero in some random pose.
    """
    poses = all_poses.subset(slice(0, all_poses.random_count))
    if not are_invertible(poses.pose_matrices).all():
        raise RecordingError(
            "A bone has a scale of zero in some pose, so key joints cannot be chosen; look for the key, constraint or "
            "driver that sets it."
        )
    moments, acts = _measure_vertices(poses)
    blocks = InputBlocks(poses)
    # Measure how far frames of actions move joints from where random poses have them, relative to reference joints.
    is_usable = are_invertible(all_poses.pose_matrices).all(axis=1)
    is_usable[: all_poses.random_count] = True
    skin = skin_matrices(all_poses.pose_matrices[is_usable], all_poses.rig.rest_matrices).astype(np.float64)
    variances, axes = np.linalg.eigh(moments)
    moment_roots = axes * np.sqrt(np.maximum(variances, 0))[:, None]
    unseen_motions = np.zeros(len(moments))
    for joint, reference in enumerate(all_poses.rig.references.tolist()):
        relative = np.linalg.solve(skin[:, reference], skin[:, joint]) if reference >= 0 else skin[:, joint]
        motion = (relative @ moment_roots[joint])[:, :3]
        motion -= motion[: all_poses.random_count].mean(axis=0)
        unseen_motions[joint] = np.sqrt((motion**2).sum(axis=(1, 2))).max()
    is_unseen = (blocks.widths[: len(moments)] == 0) & (unseen_motions > TOLERANCE_RATIO * poses.rig.size)
    is_static = np.array([name == STATIC_JOINT for name in poses.rig.joint_names])
    search = KeyJointSearch(poses, moments, blocks, is_static, is_unseen)
    search.search(None if requested == AUTO else int(requested), on_progress)
    return search.result(requested, acts, poses.rig.metres_per_unit)


def _measure_vertices(poses: FitPoses) -> tuple[np.ndarray, np.ndarray]:
    """Find the vertices that each joint moves.

    The weights of a rig may be those of a cage, or none. So these are the vertices where either the rig has a weight,
    or a fit with all joints has one. The fit takes one vertex of each small patch of the mesh.

    Returns:
        (J, 4, 4) moments of the vertices of each joint, as of `joint_moments`, and (V, J) bool, whether a joint acts on
        a vertex.
    """
    rig, joint_count = poses.rig, len(poses.rig.joints)
    patches = [patch for partition in make_partitions(rig) for patch in _cut(rig.rest_positions, partition.vertices)]
    representatives = np.array([patch[0] for patch in patches])
    fitted_joints, fitted_weights = fit_skin(poses.subset(slice(0, None, 2)).of_vertices(representatives), "smooth")
    moments = joint_moments(rig.rest_positions, rig.skin_joints, rig.skin_weights, joint_count)
    fitted_moments = joint_moments(rig.rest_positions[representatives], fitted_joints, fitted_weights, joint_count)
    # The last element is the mean square weight.
    moments = np.where((moments[:, 3, 3] >= fitted_moments[:, 3, 3])[:, None, None], moments, fitted_moments)
    without_vertices = poses.is_dependency & (np.trace(moments, axis1=1, axis2=2) == 0)
    # Take points around the heads of joints that move the mesh without weights.
    offsets = LENGTH_RATIO * rig.size * np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)])
    points = rig.rest_matrices[without_vertices][:, None, :3, 3] + offsets
    points = np.concatenate([points, np.ones((*points.shape[:2], 1))], axis=2)
    moments[without_vertices] = np.einsum("jpa,jpb->jab", points, points) / len(offsets)
    acts = joints_with_weight(rig.skin_joints, rig.skin_weights, joint_count)
    fitted_acts = joints_with_weight(fitted_joints, fitted_weights, joint_count)
    acts[np.concatenate(patches)] |= np.repeat(fitted_acts, [len(patch) for patch in patches], axis=0)
    return moments, acts


def _cut(rest_positions: np.ndarray, vertices: np.ndarray) -> list[np.ndarray]:
    """Cut vertices along their longest axis, until each patch has at most `MAX_PATCH_VERTICES`."""
    if len(vertices) <= MAX_PATCH_VERTICES:
        return [vertices]
    axis = int(np.argmax(np.ptp(rest_positions[vertices], axis=0)))
    ordered = vertices[np.argsort(rest_positions[vertices, axis], kind="stable")]
    halves = ordered[: len(ordered) // 2], ordered[len(ordered) // 2 :]
    return [patch for half in halves for patch in _cut(rest_positions, half)]
