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

RIG_CANDIDATES = 4
"""How many of the joints that the rig's own weights give a vertex are candidates, the heaviest first."""
SINGLE_CANDIDATES = 8
"""How many joints are candidates because each would explain the vertex best alone."""
ADDED_CANDIDATES = 4
"""How many joints take the places of candidates without weight in each round: those that improve the fit most."""
ROUNDS = 2
"""How often candidates are exchanged."""
TIE = 1e-5
"""Joints whose errors for a vertex differ by less than this part of the character's size count as equally good."""
MAX_PRUNING_LOSS = 0.1
"""A weight is left out where the error grows by no larger part without it. Every joint that moves a partition a little
is one more input to learn from: docs/experiments.md, Fitted skin weights."""
MIN_WEIGHT = 1e-3
"""Smaller weights are left out in any case."""
ROUNDING = 1e-12
"""The least ridge, as a part of the errors: less would drown in the rounding of the products."""
BLOCK_FLOATS = 1 << 22
"""Vertices are fitted in blocks, of so many numbers in the largest array."""


class SkinSolver:
    """Fits the weights of a rig's vertices to poses."""

    def __init__(self, poses: FitPoses):
        """Prepare what all vertices share, the products of all joints' matrices."""
        self._poses = poses
        rig = poses.rig
        self._count, self._joints = len(poses.pose_matrices), len(rig.joints)
        # About the middle of the mesh, at rest and in each pose: large numbers would leave the squares no digits.
        self._center = rig.rest_positions.mean(axis=0, dtype=np.float64)
        self._middles = np.array([positions.mean(axis=0, dtype=np.float64) for positions in poses.positions])
        skin = skin_matrices(poses.pose_matrices, rig.rest_matrices)[:, :, :3].astype(np.float64)
        skin[:, :, :, 3] += skin[:, :, :, :3] @ self._center - self._middles[:, None]
        self._rows = np.ascontiguousarray(skin.transpose(0, 2, 1, 3).reshape(3 * self._count, 4 * self._joints))
        self._products = self._rows.T @ self._rows
        blocks = self._products.reshape(self._joints, 4, self._joints, 4).transpose(0, 2, 1, 3)
        self._blocks = np.ascontiguousarray(blocks).reshape(self._joints, self._joints, 16)
        self._size = max(rig.size, 1e-9)
        self.tie = self._count * (TIE * self._size) ** 2
        self._heads = rig.rest_matrices[:, :3, 3].astype(np.float64) - self._center

    def fit(self, kind: str) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
        """Fit all vertices, a block an iteration.

        Args:
            kind: "hard" for one joint a vertex, "smooth" for at most four.

        Yields:
            The vertices of the block, (B, 4) int32 joints, the heaviest first, and (B, 4) float32 weights. Each row
            sums to 1; unused places hold 0.
        """
        tried = RIG_CANDIDATES + SINGLE_CANDIDATES + ADDED_CANDIDATES
        step = max(1, BLOCK_FLOATS // max(16 * tried**2, 4 * self._joints, 3 * self._count))
        vertices = self._poses.rig.vertex_count
        for start in range(0, vertices, step):
            block = slice(start, min(start + step, vertices))
            yield block, *_Block(self, block).fit(kind)


class _Block:
    """Some vertices, their moments with all joints, and what is known of single joints.

    Attributes:
        rest: (B, 4) float64, homogeneous rest positions about the middle of the mesh, mesh units.
        moments: (4 J, B), of the recorded positions. linear: (B, J), of each joint's skinned position with them.
        squares: (B,), of the recorded positions. alone: (B, J), squared error of each joint alone. All are sums over
            the poses, in square mesh units.
        preference: (B, J), which joint to take where several are as good: lower is better, below 0 for the rig's own.
    """

    def __init__(self, solver: SkinSolver, vertices: slice):
        self._solver = solver
        poses, rig = solver._poses, solver._poses.rig
        rest = rig.rest_positions[vertices].astype(np.float64) - solver._center
        self.rest = np.concatenate([rest, np.ones((len(rest), 1))], axis=1)
        recorded = poses.positions[:, vertices].astype(np.float64) - solver._middles[:, None]
        recorded = recorded.transpose(0, 2, 1).reshape(-1, len(rest))
        self.moments = solver._rows.T @ recorded
        self.squares = (recorded**2).sum(axis=0)
        self.linear = self._by_joint(self.moments)
        outer = (self.rest[:, :, None] * self.rest[:, None]).reshape(-1, 16)
        own = outer @ solver._blocks[range(solver._joints), range(solver._joints)].T
        self.alone = np.maximum(own - 2 * self.linear + self.squares[:, None], 0)
        distances = np.linalg.norm(rest[:, None] - solver._heads, axis=2)
        self.preference = np.minimum(distances / solver._size, 1)
        self._own = np.zeros((len(rest), solver._joints))
        rows = np.repeat(np.arange(len(rest)), rig.skin_joints.shape[1])
        np.add.at(self._own, (rows, rig.skin_joints[vertices].ravel()), rig.skin_weights[vertices].ravel())
        self.preference = np.where(self._own > 0, -self._own, self.preference)

    def _by_joint(self, moments: np.ndarray) -> np.ndarray:
        """(4 J, B) moments to (B, J): their products with the rest positions."""
        return np.einsum("jkv,vk->vj", moments.reshape(-1, 4, len(self.rest)), self.rest)

    @property
    def _rank(self) -> np.ndarray:
        """(B, J) rms error of each joint alone, mesh units, with a step for the preference that decides ties."""
        return np.sqrt(self.alone / self._solver._count) + TIE * self._solver._size * self.preference

    def fit(self, kind: str) -> tuple[np.ndarray, np.ndarray]:
        """(B, 4) int32 joints and (B, 4) float32 weights, as `SkinSolver.fit`."""
        rank = self._rank
        if kind == "hard":
            return _padded(rank.argmin(axis=1)[:, None], np.ones((len(rank), 1)))
        rank[self._own_places()] = self.preference[self._own_places()] - 2
        tried = np.argsort(rank, axis=1, kind="stable")[:, : RIG_CANDIDATES + SINGLE_CANDIDATES]
        weights, squares = self._solve(tried)
        for _ in range(ROUNDS if tried.shape[1] < self._solver._joints else 0):
            kept = np.sort(np.argsort(-weights, axis=1, kind="stable")[:, : RIG_CANDIDATES + SINGLE_CANDIDATES], axis=1)
            tried, weights = (np.take_along_axis(array, kept, axis=1) for array in (tried, weights))
            tried = np.concatenate([tried, self._improving(tried, weights)], axis=1)
            weights, squares = self._solve(tried)
        return _padded(*self._pruned(tried, weights, squares))

    def _own_places(self) -> np.ndarray:
        """(B, J) bool, where a joint is one of the heaviest of the rig's own weights of a vertex."""
        heaviest = np.argsort(-self._own, axis=1, kind="stable")[:, :RIG_CANDIDATES]
        places = np.zeros(self._own.shape, bool)
        np.put_along_axis(places, heaviest, True, axis=1)
        return places & (self._own > 0)

    def _improving(self, tried: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """(B, n) further joints, those along which the error of the weights so far falls the fastest."""
        dense = np.zeros((len(tried), self._solver._joints))
        np.put_along_axis(dense, tried, weights, axis=1)
        combined = (dense[:, :, None] * self.rest[:, None]).reshape(len(dense), -1).T
        slopes = self._by_joint(self._solver._products @ combined - self.moments)
        np.put_along_axis(slopes, tried, np.inf, axis=1)
        return np.argsort(slopes, axis=1, kind="stable")[
            :, : min(ADDED_CANDIDATES, self._solver._joints - tried.shape[1])
        ]

    def _pruned(self, tried: np.ndarray, weights: np.ndarray, squares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Joints and weights, at most four a vertex, and none without which the others do nearly as well.

        The smallest weight goes first, and the others are solved again. `squares` is what the weights leave.
        """
        order = np.argsort(-weights, axis=1, kind="stable")[:, : (weights > MIN_WEIGHT).sum(axis=1).max()]
        tried, weights = (np.take_along_axis(array, order, axis=1) for array in (tried, weights))
        allowed, limits = weights > MIN_WEIGHT, self._limits(squares)
        left = np.arange(len(weights))
        while len(left := left[allowed[left].sum(axis=1) > 1]):
            fewer = allowed[left]
            fewer[np.arange(len(left)), np.where(fewer, weights[left], np.inf).argmin(axis=1)] = False
            solved, squares = self._solve(tried, fewer, left)
            must = allowed[left].sum(axis=1) > INFLUENCES
            good = must | (squares <= limits[left])
            left, solved, squares, fewer = left[good], solved[good], squares[good], fewer[good]
            weights[left], allowed[left] = solved, fewer & (solved > MIN_WEIGHT)
            # What four weights leave is what fewer are measured by.
            limits[left] = np.where(must[good], self._limits(squares), limits[left])
        return tried, np.where(allowed, weights, 0)

    def _limits(self, squares: np.ndarray) -> np.ndarray:
        """Squared errors that fewer weights may leave where more leave `squares`."""
        return squares * (1 + MAX_PRUNING_LOSS) ** 2 + self._solver.tie

    def _solve(
        self, tried: np.ndarray, allowed: np.ndarray | None = None, chosen: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Weights of the joints that are tried, and what they leave.

        Args:
            tried: (B, C) joint indices, no joint twice.
            allowed: (n, C) bool, which of them may have a weight; all of them when left out.
            chosen: (n,) indices of the vertices to solve; all of them when left out.

        Returns:
            (n, C) non-negative weights, each row summing to 1, and (n,) squared errors, summed over the poses.
        """
        chosen = np.arange(len(tried)) if chosen is None else chosen
        errors = self._errors(tried[chosen], chosen)
        usable = np.ones(errors.shape[:2], bool) if allowed is None else allowed
        usable = usable & ~_repeated(errors, self._solver.tie)
        weights = simplex_weights(errors, usable, self._solver.tie)
        return weights, np.maximum(np.einsum("vj,vjk,vk->v", weights, errors, weights), 0)

    def _errors(self, tried: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """(B, C, C): with e_nj = S_nj x - y_n, sum_n e_nj . e_nk of the joints that are tried, square mesh units.

        Where weights sum to 1, w' E w is the squared error of skinning with them.
        """
        outer = (self.rest[chosen, :, None] * self.rest[chosen, None]).reshape(-1, 16)
        blocks = self._solver._blocks[tried[:, :, None], tried[:, None, :]]
        linear = np.take_along_axis(self.linear[chosen], tried, axis=1)
        moved = np.einsum("vjkm,vm->vjk", blocks, outer)
        return moved - linear[:, :, None] - linear[:, None] + self.squares[chosen, None, None]


def _repeated(errors: np.ndarray, tolerance: float) -> np.ndarray:
    """(B, C) bool, which joints move their vertex as one that stands before them does, to a squared distance."""
    alone = np.einsum("vjj->vj", errors)
    apart = alone[:, :, None] + alone[:, None] - 2 * errors
    return (np.tril(apart <= tolerance, -1)).any(axis=2)


def simplex_weights(errors: np.ndarray, usable: np.ndarray, ridge: float) -> np.ndarray:
    """Minimize w' E w with w >= 0 and sum w = 1.

    Without the sum, min over u >= 0 of u' E u + (1 - sum u)^2 has the same solution up to a factor: for u = s w the
    best s leaves q / (1 + q) with q = w' E w, which grows with q. And that is a problem of non-negative least squares.

    Args:
        errors: (B, C, C) symmetric, positive semi-definite.
        usable: (B, C) bool, which weights may differ from 0; at least one a row.
        ridge: added to the diagonal, so that what hardly differs shares its weight.

    Returns:
        (B, C) float64.
    """
    scale = np.maximum(np.einsum("vjj->vj", errors).mean(axis=1), ridge)
    both = usable[:, :, None] & usable[:, None]
    places = np.arange(errors.shape[1])
    normal = np.where(both, errors / scale[:, None, None] + 1, 0)
    normal[:, places, places] += np.where(usable, np.maximum(ridge / scale, ROUNDING)[:, None], 1)
    factors = np.linalg.cholesky(normal)
    wanted = np.linalg.solve(factors, usable[:, :, None].astype(np.float64))[:, :, 0]
    triangles = np.ascontiguousarray(factors.transpose(0, 2, 1))
    solved = np.array([nnls(triangle, target)[0] for triangle, target in zip(triangles, wanted, strict=True)])
    solved[~usable] = 0
    return solved / solved.sum(axis=1, keepdims=True)


def _padded(joints: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(B, C) joints and weights to (B, 4) int32 and float32, the heaviest first; unused places hold 0."""
    order = np.argsort(-weights, axis=1, kind="stable")[:, :INFLUENCES]
    joints, weights = (np.take_along_axis(array, order, axis=1) for array in (joints, weights))
    weights = np.where(weights > 0, weights / weights.sum(axis=1, keepdims=True), 0)
    wider = ((0, 0), (0, INFLUENCES - weights.shape[1]))
    return np.pad(np.where(weights > 0, joints, 0), wider).astype(np.int32), np.pad(weights, wider).astype(np.float32)
