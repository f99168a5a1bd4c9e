# SPDX-License-Identifier: GPL-3.0-or-later
"""Skin weights that explain recorded poses, fitted vertex by vertex.

For a vertex, find weights w that minimize sum_n |sum_j w_j S_nj x - y_n|^2 with w >= 0 and sum w = 1: rigid (one joint)
or at most four joints. The idea and the sparsity: James and Twigg, Skinning Mesh Animations, 2005; Le and Deng, Smooth
Skinning Decomposition with Rigid Bones, 2012. The least squares: `scipy.optimize.nnls`, Lawson and Hanson, 1974.
"""

from collections.abc import Iterator

import numpy as np
from scipy.optimize import nnls

from fdda_addon.core.recording.fit_folder import FitPoses
from fdda_addon.core.skin_fit import INFLUENCES
from fdda_addon.core.skinning import skin_matrices

from .blocks import BLOCK_ELEMENTS

RIG_CANDIDATES = 4
"""Number of candidates from the rig's own weights of a vertex, the heaviest first."""
SINGLE_CANDIDATES = 8
"""Number of candidates that explain the vertex best alone."""
ADDED_CANDIDATES = 4
"""Number of candidates that each round adds in place of those without weight: those that improve the fit most."""
EXCHANGE_ROUNDS = 2
"""Number of rounds that exchange candidates."""
TIE_RATIO = 1e-5
"""Joints whose errors for a vertex differ by less than this part of the character's size count as equal."""
MAX_PRUNING_LOSS = 0.1
"""A weight is removed where the error grows by at most this part without it. Each joint that moves a partition is one
more input of its network: docs/experiments.md, Fitted skin weights."""
MIN_WEIGHT = 1e-3
"""Smaller weights are always removed."""
MIN_RIDGE_RATIO = 1e-12
"""Minimum ridge, as a part of the errors: less would be lost in the rounding of the products."""


class SkinSolver:
    """Fits the weights of a rig's vertices to poses."""

    def __init__(self, poses: FitPoses):
        """Compute the products of all joints' skin matrices, which all vertices share."""
        self._poses = poses
        rig = poses.rig
        self._pose_count, self._joint_count = len(poses.pose_matrices), len(rig.joints)
        skin = skin_matrices(poses.pose_matrices, rig.rest_matrices)[:, :, :3].astype(np.float64)
        self._rows = np.ascontiguousarray(
            skin.transpose(0, 2, 1, 3).reshape(3 * self._pose_count, 4 * self._joint_count)
        )
        self._products = self._rows.T @ self._rows
        blocks = self._products.reshape(self._joint_count, 4, self._joint_count, 4).transpose(0, 2, 1, 3)
        self._blocks = np.ascontiguousarray(blocks).reshape(self._joint_count, self._joint_count, 16)
        self._size = max(rig.size, 1e-9)
        self.tie = self._pose_count * (TIE_RATIO * self._size) ** 2
        self._heads = rig.rest_matrices[:, :3, 3].astype(np.float64)

    def fit(self, kind: str) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
        """Fit all vertices, block by block.

        Args:
            kind: "hard" for one joint per vertex, "smooth" for at most four.

        Yields:
            The vertices of the block, (B, 4) int32 joints, the heaviest first, and (B, 4) float32 weights. Each row
            sums to 1; unused slots are 0.
        """
        max_candidates = RIG_CANDIDATES + SINGLE_CANDIDATES + ADDED_CANDIDATES
        step = max(1, BLOCK_ELEMENTS // max(16 * max_candidates**2, 4 * self._joint_count, 3 * self._pose_count))
        vertices = self._poses.rig.vertex_count
        for start in range(0, vertices, step):
            block = slice(start, min(start + step, vertices))
            yield block, *_Block(self, block).fit(kind)


class _Block:
    """A block of B vertices, their moments with all joints, and the errors of single joints.

    Attributes:
        rest: (B, 4) float64, homogeneous rest positions, mesh units.
        moments: (4 J, B), products of the skin matrices with the recorded positions, square mesh units.
        linear: (B, J), products of each joint's skinned position with the recorded positions, square mesh units.
        squares: (B,), squared recorded positions, square mesh units.
        single_errors: (B, J), squared error of each joint alone, square mesh units. All of these are sums over poses.
        preference: (B, J), which joint to take where errors are equal: lower is better, below 0 for the rig's own.
    """

    def __init__(self, solver: SkinSolver, vertices: slice):
        self._solver = solver
        poses, rig = solver._poses, solver._poses.rig
        rest = rig.rest_positions[vertices].astype(np.float64)
        self.rest = np.concatenate([rest, np.ones((len(rest), 1))], axis=1)
        recorded = poses.positions[:, vertices].astype(np.float64).transpose(0, 2, 1).reshape(-1, len(rest))
        self.moments = solver._rows.T @ recorded
        self.squares = (recorded**2).sum(axis=0)
        self.linear = self._by_joint(self.moments)
        outer = (self.rest[:, :, None] * self.rest[:, None]).reshape(-1, 16)
        skinned_squares = outer @ solver._blocks[range(solver._joint_count), range(solver._joint_count)].T
        self.single_errors = np.maximum(skinned_squares - 2 * self.linear + self.squares[:, None], 0)
        distances = np.linalg.norm(rest[:, None] - solver._heads, axis=2)
        self.preference = np.minimum(distances / solver._size, 1)
        self._rig_weights = np.zeros((len(rest), solver._joint_count))
        rows = np.repeat(np.arange(len(rest)), rig.skin_joints.shape[1])
        np.add.at(self._rig_weights, (rows, rig.skin_joints[vertices].ravel()), rig.skin_weights[vertices].ravel())
        self.preference = np.where(self._rig_weights > 0, -self._rig_weights, self.preference)

    def _by_joint(self, moments: np.ndarray) -> np.ndarray:
        """Convert (4 J, B) moments to (B, J), their products with the rest positions."""
        return np.einsum("jkv,vk->vj", moments.reshape(-1, 4, len(self.rest)), self.rest)

    @property
    def _scores(self) -> np.ndarray:
        """Return (B, J) rms errors of single joints, mesh units, plus a small term of the preference for ties."""
        return np.sqrt(self.single_errors / self._solver._pose_count) + TIE_RATIO * self._solver._size * self.preference

    def fit(self, kind: str) -> tuple[np.ndarray, np.ndarray]:
        """Fit the block; returns (B, 4) int32 joints and (B, 4) float32 weights as in `SkinSolver.fit`."""
        scores = self._scores
        if kind == "hard":
            return _padded(scores.argmin(axis=1)[:, None], np.ones((len(scores), 1)))
        scores[self._rig_candidates()] = self.preference[self._rig_candidates()] - 2
        candidates = np.argsort(scores, axis=1, kind="stable")[:, : RIG_CANDIDATES + SINGLE_CANDIDATES]
        weights, squares = self._solve(candidates)
        for _ in range(EXCHANGE_ROUNDS if candidates.shape[1] < self._solver._joint_count else 0):
            order = np.sort(
                np.argsort(-weights, axis=1, kind="stable")[:, : RIG_CANDIDATES + SINGLE_CANDIDATES], axis=1
            )
            candidates, weights = (np.take_along_axis(array, order, axis=1) for array in (candidates, weights))
            candidates = np.concatenate([candidates, self._steepest_joints(candidates, weights)], axis=1)
            weights, squares = self._solve(candidates)
        return _padded(*self._pruned(candidates, weights, squares))

    def _rig_candidates(self) -> np.ndarray:
        """Return (B, J) bool, which joints are among the heaviest of the rig's own weights of a vertex."""
        heaviest = np.argsort(-self._rig_weights, axis=1, kind="stable")[:, :RIG_CANDIDATES]
        is_candidate = np.zeros(self._rig_weights.shape, bool)
        np.put_along_axis(is_candidate, heaviest, True, axis=1)
        return is_candidate & (self._rig_weights > 0)

    def _steepest_joints(self, candidates: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return (B, n) further joints, along whose weights the error of the current weights falls fastest."""
        dense_weights = np.zeros((len(candidates), self._solver._joint_count))
        np.put_along_axis(dense_weights, candidates, weights, axis=1)
        combined = (dense_weights[:, :, None] * self.rest[:, None]).reshape(len(dense_weights), -1).T
        slopes = self._by_joint(self._solver._products @ combined - self.moments)
        np.put_along_axis(slopes, candidates, np.inf, axis=1)
        return np.argsort(slopes, axis=1, kind="stable")[
            :, : min(ADDED_CANDIDATES, self._solver._joint_count - candidates.shape[1])
        ]

    def _pruned(
        self, candidates: np.ndarray, weights: np.ndarray, squares: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Remove weights until a vertex has at most four, and none that hardly lowers the error.

        The smallest weight is removed first, and the others are solved again.

        Args:
            candidates, weights: (B, C) joints and their weights.
            squares: (B,) squared errors of the weights.
        """
        order = np.argsort(-weights, axis=1, kind="stable")[:, : (weights > MIN_WEIGHT).sum(axis=1).max()]
        candidates, weights = (np.take_along_axis(array, order, axis=1) for array in (candidates, weights))
        allowed, limits = weights > MIN_WEIGHT, self._limits(squares)
        rows = np.arange(len(weights))
        while len(rows := rows[allowed[rows].sum(axis=1) > 1]):
            reduced = allowed[rows]
            reduced[np.arange(len(rows)), np.where(reduced, weights[rows], np.inf).argmin(axis=1)] = False
            solved, squares = self._solve(candidates, reduced, rows)
            is_required = allowed[rows].sum(axis=1) > INFLUENCES
            is_accepted = is_required | (squares <= limits[rows])
            rows, solved = rows[is_accepted], solved[is_accepted]
            squares, reduced = squares[is_accepted], reduced[is_accepted]
            weights[rows], allowed[rows] = solved, reduced & (solved > MIN_WEIGHT)
            # The limit for fewer weights is relative to the error of four.
            limits[rows] = np.where(is_required[is_accepted], self._limits(squares), limits[rows])
        return candidates, np.where(allowed, weights, 0)

    def _limits(self, squares: np.ndarray) -> np.ndarray:
        """Return the squared errors that fewer weights may have where more weights have `squares`."""
        return squares * (1 + MAX_PRUNING_LOSS) ** 2 + self._solver.tie

    def _solve(
        self, candidates: np.ndarray, allowed: np.ndarray | None = None, rows: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Solve for the weights of the candidates.

        Args:
            candidates: (B, C) joint indices, no joint twice.
            allowed: (n, C) bool, which candidates may have a weight; None for all.
            rows: (n,) indices of the vertices to solve; None for all.

        Returns:
            (n, C) non-negative weights, each row summing to 1, and (n,) squared errors, summed over the poses.
        """
        rows = np.arange(len(candidates)) if rows is None else rows
        errors = self._errors(candidates[rows], rows)
        usable = np.ones(errors.shape[:2], bool) if allowed is None else allowed
        usable = usable & ~_repeated(errors, self._solver.tie)
        weights = simplex_weights(errors, usable, self._solver.tie)
        return weights, np.maximum(np.einsum("vj,vjk,vk->v", weights, errors, weights), 0)

    def _errors(self, candidates: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return the (n, C, C) error matrices E of the candidates: sum_n e_nj . e_nk with e_nj = S_nj x - y_n.

        Where weights sum to 1, w' E w is the squared error of skinning with them, in square mesh units.
        """
        outer = (self.rest[rows, :, None] * self.rest[rows, None]).reshape(-1, 16)
        blocks = self._solver._blocks[candidates[:, :, None], candidates[:, None, :]]
        linear = np.take_along_axis(self.linear[rows], candidates, axis=1)
        moved = np.einsum("vjkm,vm->vjk", blocks, outer)
        return moved - linear[:, :, None] - linear[:, None] + self.squares[rows, None, None]


def _repeated(errors: np.ndarray, tolerance: float) -> np.ndarray:
    """Return (B, C) bool, which candidates move the vertex like an earlier one, up to a squared distance."""
    diagonal = np.einsum("vjj->vj", errors)
    squared_distances = diagonal[:, :, None] + diagonal[:, None] - 2 * errors
    return (np.tril(squared_distances <= tolerance, -1)).any(axis=2)


def simplex_weights(errors: np.ndarray, usable: np.ndarray, ridge: float) -> np.ndarray:
    """Minimize w' E w with w >= 0 and sum w = 1.

    The problem min over u >= 0 of u' E u + (1 - sum u)^2 has the same solution up to a factor: for u = s w the minimum
    over s is q / (1 + q) with q = w' E w, which grows with q. That is a non-negative least squares problem.

    Args:
        errors: (B, C, C) symmetric, positive semi-definite.
        usable: (B, C) bool, which weights may differ from 0; at least one per row.
        ridge: added to the diagonal, so that nearly equal joints share their weight.

    Returns:
        (B, C) float64.
    """
    scale = np.maximum(np.einsum("vjj->vj", errors).mean(axis=1), ridge)
    is_pair_usable = usable[:, :, None] & usable[:, None]
    diagonal = np.arange(errors.shape[1])
    normal = np.where(is_pair_usable, errors / scale[:, None, None] + 1, 0)
    normal[:, diagonal, diagonal] += np.where(usable, np.maximum(ridge / scale, MIN_RIDGE_RATIO)[:, None], 1)
    factors = np.linalg.cholesky(normal)
    targets = np.linalg.solve(factors, usable[:, :, None].astype(np.float64))[:, :, 0]
    triangles = np.ascontiguousarray(factors.transpose(0, 2, 1))
    solved = np.array([nnls(triangle, target)[0] for triangle, target in zip(triangles, targets, strict=True)])
    solved[~usable] = 0
    return solved / solved.sum(axis=1, keepdims=True)


def _padded(joints: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Convert (B, C) joints and weights to (B, 4) int32 and float32, the heaviest first; unused slots are 0."""
    order = np.argsort(-weights, axis=1, kind="stable")[:, :INFLUENCES]
    joints, weights = (np.take_along_axis(array, order, axis=1) for array in (joints, weights))
    weights = np.where(weights > 0, weights / weights.sum(axis=1, keepdims=True), 0)
    padding = ((0, 0), (0, INFLUENCES - weights.shape[1]))
    return np.pad(np.where(weights > 0, joints, 0), padding).astype(np.int32), np.pad(weights, padding).astype(
        np.float32
    )
