# SPDX-License-Identifier: GPL-3.0-or-later
"""Fits skin weights to recorded poses, one vertex at a time.

The weights w of a vertex minimize sum_n |sum_j w_j S_nj x - y_n|^2 with w >= 0 and sum w = 1. Here x is the rest
position, y_n the recorded position in pose n, and S_nj the skin matrix of joint j. A vertex has one joint (rigid
skinning) or at most four joints.

References for the method and its sparsity: James and Twigg, Skinning Mesh Animations, 2005; Le and Deng, Smooth
Skinning Decomposition with Rigid Bones, 2012. The least-squares solver is `scipy.optimize.nnls` (Lawson and Hanson,
1974).
"""

from collections.abc import Callable

import numpy as np

from fdda_addon.core.mathematics.blocks import block_slices
from fdda_addon.core.mathematics.skin_fit import INFLUENCES
from fdda_addon.core.mathematics.skinning import skin_matrices

from .fit_poses import FitPoses

RIG_CANDIDATES = 4
"""Number of candidate joints of a vertex that come from its weights in the rig, the heaviest first."""
SINGLE_CANDIDATES = 8
"""Number of candidate joints of a vertex that have the smallest error as its only joint."""
ADDED_CANDIDATES = 4
"""Number of candidates that improve the fit most. Each round adds them in place of candidates without weight."""
EXCHANGE_ROUNDS = 2
"""Number of rounds that exchange candidates."""
TIE_RATIO = 1e-5
"""Joints whose errors for a vertex differ by less than this part of the character's size count as equal."""
MAX_PRUNING_LOSS = 0.1
"""Maximum relative increase of the error when a weight is removed. Each further joint of a partition is one more input
of its network: docs/experiments.md, Fitted skin weights."""
MIN_WEIGHT = 1e-3
"""Smaller weights are always removed."""
MIN_RIDGE_RATIO = 1e-12
"""Minimum ridge, as a part of the errors. A smaller ridge would be less than the rounding errors of the products."""


def fit_skin(
    poses: FitPoses,
    kind: str,
    on_progress: Callable[[int], None] = lambda done: None,
    influences: int = INFLUENCES,
    max_pruning_loss: float = MAX_PRUNING_LOSS,
) -> tuple[np.ndarray, np.ndarray]:
    """Fit the weights of a rig's V vertices to poses.

    Args:
        kind: "hard" for one joint per vertex, "smooth" for at most I.
        on_progress: called often with the number of fitted vertices.
        influences: largest number of joints per vertex, I.
        max_pruning_loss: as `MAX_PRUNING_LOSS`.

    Returns:
        (V, I) int32 joints, the heaviest first, and (V, I) float32 weights. Each row sums to 1; unused slots are 0.
    """
    solver, vertex_count = _Solver(poses, influences, max_pruning_loss), poses.rig.vertex_count
    joints, weights = (np.zeros((vertex_count, influences), dtype) for dtype in (np.int32, np.float32))
    max_candidates = RIG_CANDIDATES + SINGLE_CANDIDATES + ADDED_CANDIDATES
    vertex_elements = max(16 * max_candidates**2, *solver.skin_rows.shape)
    for block in block_slices(vertex_count, vertex_elements):
        joints[block], weights[block] = _Block(solver, block).fit(kind)
        on_progress(block.stop)
    return joints, weights


class _Solver:
    """What all vertices share.

    Attributes:
        poses, pose_count, joint_count: the n poses of J joints.
        influences, max_pruning_loss: as for `fit_skin`.
        skin_rows: (3 n, 4 J) float64, skin matrices of all poses.
        gram, gram_blocks: (4 J, 4 J) and (J, J, 16), products of the skin matrices.
        character_size: largest extent of the rig, mesh units.
        tie_squared_error: squared errors that differ by less count as equal.
        joint_heads: (J, 3) float64, mesh units.
    """

    def __init__(self, poses: FitPoses, influences: int, max_pruning_loss: float):
        self.poses, self.influences, self.max_pruning_loss = poses, influences, max_pruning_loss
        rig = poses.rig
        self.pose_count, self.joint_count = len(poses.pose_matrices), len(rig.joints)
        skin = skin_matrices(poses.pose_matrices, rig.rest_matrices)[:, :, :3].astype(np.float64)
        self.skin_rows = np.ascontiguousarray(
            skin.transpose(0, 2, 1, 3).reshape(3 * self.pose_count, 4 * self.joint_count)
        )
        self.gram = self.skin_rows.T @ self.skin_rows
        gram_blocks = self.gram.reshape(self.joint_count, 4, self.joint_count, 4).transpose(0, 2, 1, 3)
        self.gram_blocks = np.ascontiguousarray(gram_blocks).reshape(self.joint_count, self.joint_count, 16)
        self.character_size = max(rig.size, 1e-9)
        self.tie_squared_error = self.pose_count * (TIE_RATIO * self.character_size) ** 2
        self.joint_heads = rig.rest_matrices[:, :3, 3].astype(np.float64)


class _Block:
    """A block of B vertices, and their moments with all joints.

    Attributes:
        rest: (B, 4) float64, homogeneous rest positions, mesh units.
        moments: (4 J, B), products of the skin matrices with the recorded positions.
        joint_moments: (B, J), products of the position skinned to each joint with the recorded position.
        recorded_squares: (B,), squared recorded positions.
        rig_weights: (B, J), weights in the rig, no unit.

    Moments, squares and errors are sums over the poses, in square mesh units.
    """

    def __init__(self, solver: _Solver, vertices: slice):
        self._solver = solver
        poses, rig = solver.poses, solver.poses.rig
        rest_positions = rig.rest_positions[vertices].astype(np.float64)
        self.rest = np.concatenate([rest_positions, np.ones((len(rest_positions), 1))], axis=1)
        recorded = poses.positions[:, vertices].astype(np.float64).transpose(0, 2, 1).reshape(-1, len(rest_positions))
        self.moments = solver.skin_rows.T @ recorded
        self.recorded_squares = (recorded**2).sum(axis=0)
        self.joint_moments = self._project_to_joints(self.moments)
        self.rig_weights = np.zeros((len(rest_positions), solver.joint_count))
        rows = np.arange(len(rest_positions))[:, None]
        np.add.at(self.rig_weights, (rows, rig.skin_joints[vertices]), rig.skin_weights[vertices])

    def _project_to_joints(self, moments: np.ndarray) -> np.ndarray:
        """Multiply the (4 J, B) moments by the rest positions; returns one (B, J) value for each joint."""
        return np.einsum("jkv,vk->vj", moments.reshape(-1, 4, len(self.rest)), self.rest)

    def fit(self, kind: str) -> tuple[np.ndarray, np.ndarray]:
        """Fit the block; returns (B, I) int32 joints and (B, I) float32 weights as in `fit_skin`."""
        solver, outer = self._solver, (self.rest[:, :, None] * self.rest[:, None]).reshape(-1, 16)
        skinned_squares = outer @ solver.gram_blocks[range(solver.joint_count), range(solver.joint_count)].T
        single_errors = np.maximum(skinned_squares - 2 * self.joint_moments + self.recorded_squares[:, None], 0)
        # A small preference, the lower the better, decides ties between rms errors. It is below 0 for rig weights.
        distances = np.linalg.norm(self.rest[:, None, :3] - solver.joint_heads, axis=2)
        preferences = np.minimum(distances / solver.character_size, 1)
        preferences = np.where(self.rig_weights > 0, -self.rig_weights, preferences)
        scores = np.sqrt(single_errors / solver.pose_count) + TIE_RATIO * solver.character_size * preferences
        if kind == "hard":
            return _pad_influences(scores.argmin(axis=1)[:, None], np.ones((len(scores), 1)), solver.influences)
        heaviest = np.argsort(-self.rig_weights, axis=1, kind="stable")[:, :RIG_CANDIDATES]
        is_rig_candidate = np.zeros(scores.shape, bool)
        np.put_along_axis(is_rig_candidate, heaviest, True, axis=1)
        is_rig_candidate &= self.rig_weights > 0
        scores[is_rig_candidate] = preferences[is_rig_candidate] - 2
        candidates = np.argsort(scores, axis=1, kind="stable")[:, : RIG_CANDIDATES + SINGLE_CANDIDATES]
        weights, squared_errors = self._solve(candidates)
        for _ in range(EXCHANGE_ROUNDS if candidates.shape[1] < solver.joint_count else 0):
            slot_order = np.sort(
                np.argsort(-weights, axis=1, kind="stable")[:, : RIG_CANDIDATES + SINGLE_CANDIDATES], axis=1
            )
            candidates, weights = (np.take_along_axis(array, slot_order, axis=1) for array in (candidates, weights))
            dense_weights = np.zeros((len(candidates), solver.joint_count))
            np.put_along_axis(dense_weights, candidates, weights, axis=1)
            combined = (dense_weights[:, :, None] * self.rest[:, None]).reshape(len(dense_weights), -1).T
            slopes = self._project_to_joints(solver.gram @ combined - self.moments)
            np.put_along_axis(slopes, candidates, np.inf, axis=1)
            new_count = solver.joint_count - candidates.shape[1]
            # Add the joints where adding weight lowers the error fastest.
            steepest = np.argsort(slopes, axis=1, kind="stable")
            candidates = np.concatenate([candidates, steepest[:, : min(ADDED_CANDIDATES, new_count)]], axis=1)
            weights, squared_errors = self._solve(candidates)
        return _pad_influences(*self._prune(candidates, weights, squared_errors), solver.influences)

    def _prune(
        self, candidates: np.ndarray, weights: np.ndarray, squared_errors: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Remove weights until each vertex has at most I and each weight lowers the error noticeably.

        The smallest weight is removed first. Then the remaining weights are solved again.

        Args:
            candidates, weights: (B, C) joints and their weights.
            squared_errors: (B,) squared errors of the weights.
        """
        slot_order = np.argsort(-weights, axis=1, kind="stable")[:, : (weights > MIN_WEIGHT).sum(axis=1).max()]
        candidates, weights = (np.take_along_axis(array, slot_order, axis=1) for array in (candidates, weights))
        is_allowed, max_squared_errors = weights > MIN_WEIGHT, self._max_squared_errors(squared_errors)
        vertices = np.arange(len(weights))
        while len(vertices := vertices[is_allowed[vertices].sum(axis=1) > 1]):
            is_still_allowed = is_allowed[vertices]
            is_still_allowed[
                np.arange(len(vertices)), np.where(is_still_allowed, weights[vertices], np.inf).argmin(axis=1)
            ] = False
            new_weights, squared_errors = self._solve(candidates, is_still_allowed, vertices)
            is_required = is_allowed[vertices].sum(axis=1) > self._solver.influences
            is_accepted = is_required | (squared_errors <= max_squared_errors[vertices])
            vertices, new_weights = vertices[is_accepted], new_weights[is_accepted]
            squared_errors, is_still_allowed = squared_errors[is_accepted], is_still_allowed[is_accepted]
            weights[vertices], is_allowed[vertices] = new_weights, is_still_allowed & (new_weights > MIN_WEIGHT)
            # The limit for fewer than I weights is relative to the error with I weights.
            max_squared_errors[vertices] = np.where(
                is_required[is_accepted], self._max_squared_errors(squared_errors), max_squared_errors[vertices]
            )
        return candidates, np.where(is_allowed, weights, 0)

    def _max_squared_errors(self, squared_errors: np.ndarray) -> np.ndarray:
        """Return the maximum squared errors with fewer weights; `squared_errors` are the errors with more weights."""
        return squared_errors * (1 + self._solver.max_pruning_loss) ** 2 + self._solver.tie_squared_error

    def _solve(
        self, candidates: np.ndarray, is_allowed: np.ndarray | None = None, vertices: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Solve for the weights of the candidates.

        Args:
            candidates: (B, C) joint indices, no joint twice.
            is_allowed: (n, C) bool, which candidates may have a weight; None for all.
            vertices: (n,) indices of the vertices to solve, in the block; None for all.

        Returns:
            (n, C) non-negative weights, each row summing to 1, and (n,) squared errors, summed over the poses.
        """
        vertices = np.arange(len(candidates)) if vertices is None else vertices
        errors = self._errors(candidates[vertices], vertices)
        is_usable = np.ones(errors.shape[:2], bool) if is_allowed is None else is_allowed
        # Leave out candidates that move the vertex as an earlier candidate does.
        diagonal = np.einsum("vjj->vj", errors)
        squared_distances = diagonal[:, :, None] + diagonal[:, None] - 2 * errors
        is_usable = is_usable & ~(np.tril(squared_distances <= self._solver.tie_squared_error, -1)).any(axis=2)
        weights = simplex_weights(errors, is_usable, self._solver.tie_squared_error)
        return weights, np.maximum(np.einsum("vj,vjk,vk->v", weights, errors, weights), 0)

    def _errors(self, candidates: np.ndarray, vertices: np.ndarray) -> np.ndarray:
        """Return the (n, C, C) error matrices E of the candidates: sum_n e_nj . e_nk with e_nj = S_nj x - y_n.

        For weights w that sum to 1, w' E w is the squared error of skinning with w, in square mesh units.
        """
        outer = (self.rest[vertices, :, None] * self.rest[vertices, None]).reshape(-1, 16)
        gram_blocks = self._solver.gram_blocks[candidates[:, :, None], candidates[:, None, :]]
        joint_moments = np.take_along_axis(self.joint_moments[vertices], candidates, axis=1)
        skinned_products = np.einsum("vjkm,vm->vjk", gram_blocks, outer)
        return (
            skinned_products
            - joint_moments[:, :, None]
            - joint_moments[:, None]
            + self.recorded_squares[vertices, None, None]
        )


def simplex_weights(errors: np.ndarray, is_usable: np.ndarray, ridge: float) -> np.ndarray:
    """Minimize w' E w with w >= 0 and sum w = 1.

    The problem min over u >= 0 of u' E u + (1 - sum u)^2 has the same solution up to a factor: for u = s w the minimum
    over s is q / (1 + q) with q = w' E w, which grows with q. That is a non-negative least squares problem.

    Args:
        errors: (B, C, C) symmetric, positive semi-definite.
        is_usable: (B, C) bool, which weights may differ from 0; at least one per row.
        ridge: added to the diagonal, so that nearly equal joints share their weight.

    Returns:
        (B, C) float64.
    """
    # Only trainings that fit weights pay for this import.
    from scipy.optimize import nnls

    scales = np.maximum(np.einsum("vjj->vj", errors).mean(axis=1), ridge)
    is_pair_usable = is_usable[:, :, None] & is_usable[:, None]
    diagonal = np.arange(errors.shape[1])
    normal_matrices = np.where(is_pair_usable, errors / scales[:, None, None] + 1, 0)
    normal_matrices[:, diagonal, diagonal] += np.where(
        is_usable, np.maximum(ridge / scales, MIN_RIDGE_RATIO)[:, None], 1
    )
    cholesky_factors = np.linalg.cholesky(normal_matrices)
    transformed_targets = np.linalg.solve(cholesky_factors, is_usable[:, :, None].astype(np.float64))[:, :, 0]
    upper_triangles = np.ascontiguousarray(cholesky_factors.transpose(0, 2, 1))
    solutions = np.array(
        [
            nnls(upper_triangle, transformed_target)[0]
            for upper_triangle, transformed_target in zip(upper_triangles, transformed_targets, strict=True)
        ]
    )
    solutions[~is_usable] = 0
    return solutions / solutions.sum(axis=1, keepdims=True)


def _pad_influences(joints: np.ndarray, weights: np.ndarray, influences: int) -> tuple[np.ndarray, np.ndarray]:
    """Convert (B, C) joints and weights to (B, I) int32 and float32, the heaviest first; unused slots are 0."""
    slot_order = np.argsort(-weights, axis=1, kind="stable")[:, :influences]
    joints, weights = (np.take_along_axis(array, slot_order, axis=1) for array in (joints, weights))
    weights = np.where(weights > 0, weights / weights.sum(axis=1, keepdims=True), 0)
    padding = ((0, 0), (0, influences - weights.shape[1]))
    return np.pad(np.where(weights > 0, joints, 0), padding).astype(np.int32), np.pad(weights, padding).astype(
        np.float32
    )
