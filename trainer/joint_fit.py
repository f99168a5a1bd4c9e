# SPDX-License-Identifier: GPL-3.0-or-later
"""What the joints around a partition say of its residuals without a network: skinning to them, fitted.

Most of what smoothing does near a joint is that vertices follow the joints on both sides, each by its part. That is
linear in the poses of these joints, so a least squares fit finds it, and the networks learn what is left: a fraction of
the residual, and a smooth one. How much of delta mush can be had in this way: Le and Lewis, Direct Delta Mush Skinning
and Variants, 2019. Of a rig that preserves volume, most is linear in the joints' turn matrices besides (`turns`).
"""

from dataclasses import dataclass, replace

import numpy as np

from fdda_addon.core.partition import Partition
from fdda_addon.core.rig import Rig

from .inputs import joints_between, unmoved_joints

RIDGE = 1e-6
"""Added to the mean squares of the rows: joints that move alike share the fit, and no factor grows large."""
MAX_PRUNING_LOSS = 0.01
"""Joints are left out, the least useful first, while the error grows by no larger part than this over that of all."""
EQUATIONS = 4
"""Poses give at least so many equations for each number of the joints around a partition: with few all is explained."""
RANK = 1e-5
"""Directions that are smaller than this part of the largest are none."""
BLOCK_FLOATS = 1 << 22
"""Residuals are fitted in blocks of so many coordinates."""


@dataclass(frozen=True)
class JointFit:
    """The fitted part of the residuals of a partition: vertex v moves by sum_j S_j u_vj, S_j the skin matrices.

    Moving all joints together moves nothing: the last numbers of all u_vj of a vertex sum to zero.

    Attributes:
        joints: (Jf,) int64, the main joint first; none where nothing is known of the joints. J + j, behind all others,
            stands for the turn matrix of joint j, in place of its skin matrix.
        factors: (4 Jf, Vp) float32, u_vj: three mesh units and a number, joint by joint; the number is 0 for turns.
    """

    joints: np.ndarray
    factors: np.ndarray

    def offsets(self, matrices: np.ndarray) -> np.ndarray:
        """Matrices as in `make_surroundings` to (N, Vp, 3) offsets from linear skinning, mesh-object space, mesh
        units."""
        rows = matrices[:, self.joints, :3].transpose(0, 2, 1, 3).reshape(len(matrices), 3, -1)
        return (rows.astype(np.float64) @ self.factors).transpose(0, 2, 1)


@dataclass(frozen=True)
class Surroundings:
    """The joints around a partition as its main joint sees them.

    Attributes:
        joints: (Jf,) int64, the main joint first, turns last, as in `JointFit`.
        center: (3,) float64, middle of the partition at rest, mesh-object space, mesh units.
        rows: (N, 3, 4 Jf) float64, R_m^-1 S_j of each joint; the last column of each says how the center moves, which
            keeps the fit well conditioned far away from the origin.
        metres_per_unit: as in `Rig`: the ridge weighs lengths as mesh units, whatever they are in.
    """

    joints: np.ndarray
    center: np.ndarray
    rows: np.ndarray
    metres_per_unit: float = 1.0

    def alone(self) -> "Surroundings":
        """The main joint alone, seen from which nothing moves."""
        return Surroundings(self.joints[:1], self.center, self.rows[:, :, :4], self.metres_per_unit)

    def rows_of(self, joints: np.ndarray) -> np.ndarray:
        """(N, 3, 4 n) float64 rows of some of the joints, in the order given."""
        places = np.argsort(self.joints)[np.searchsorted(np.sort(self.joints), joints)]
        return self.rows[:, :, (4 * places[:, None] + np.arange(4)).ravel()]

    def are_determined(self) -> bool:
        """Whether there are poses enough for a fit to say something of others."""
        poses, _, width = self.rows.shape
        return EQUATIONS * width <= 3 * poses

    def directions(self) -> np.ndarray:
        """(3 N, r) float64, an orthonormal basis of what the joints explain of the local residuals of a vertex."""
        flat = self.rows.reshape(-1, self.rows.shape[2])
        flat = flat / np.maximum(np.linalg.norm(flat, axis=0), np.finfo(np.float64).tiny)
        left, sizes, _ = np.linalg.svd(flat, full_matrices=False)
        return left[:, sizes > RANK * sizes[0]]

    def fit(self, residuals: np.ndarray, training: np.ndarray) -> tuple[JointFit, np.ndarray]:
        """Fit local residuals.

        Args:
            residuals: (N, Vp, 3) float32 local residuals, mesh units.
            training: indices of the poses to fit.

        Returns:
            The fit, and (N, Vp, 3) float32: what it leaves of the residuals of all poses.
        """
        width = self.rows.shape[2]
        products, moments = np.zeros((width, width)), np.zeros((width, residuals.shape[1]))
        total = 0.0
        step = max(1, BLOCK_FLOATS // residuals[0].size)
        for start in range(0, len(training), step):
            poses = training[start : start + step]
            rows = self.rows[poses].reshape(-1, width)
            products += rows.T @ rows
            wanted = residuals[poses].transpose(0, 2, 1).reshape(len(rows), -1).astype(np.float64)
            moments += rows.T @ wanted
            total += (wanted**2).sum()
        ridge = np.ones(width)
        ridge[3::4] /= self.metres_per_unit**2
        products += RIDGE * len(training) * np.diag(ridge)
        kept = _useful(products, moments, total)
        columns = (4 * kept[:, None] + np.arange(4)).ravel()
        solved = np.linalg.solve(products[np.ix_(columns, columns)], moments[columns])
        left = np.empty_like(residuals)
        for start in range(0, len(residuals), step):
            poses = slice(start, start + step)
            left[poses] = residuals[poses] - (self.rows[poses][:, :, columns] @ solved).transpose(0, 2, 1)
        return JointFit(self.joints[kept], self._factors(solved.reshape(len(kept), 4, -1))), left

    def _factors(self, solved: np.ndarray) -> np.ndarray:
        """(Jf, 4, Vp) for the rows as they are to (4 Jf, Vp) for skin matrices."""
        factors, parts = solved.copy(), solved[:, 3]
        factors[0, 3] = 0
        factors[1:, :3] += self.center[:, None] * parts[1:, None]
        together = parts[1:].sum(axis=0)
        factors[0, :3] -= self.center[:, None] * together
        factors[0, 3] -= together
        return factors.reshape(-1, solved.shape[2]).astype(np.float32)


def _useful(products: np.ndarray, moments: np.ndarray, total: float) -> np.ndarray:
    """Which joints to fit to: ascending indices, the first always among them.

    Args:
        products, moments: (4 Jf, 4 Jf) and (4 Jf, Vp) of the normal equations, the ridge included.
        total: sum of the squared residuals.
    """
    kept = np.arange(len(products) // 4)
    inverse, gram = np.linalg.inv(products), moments @ moments.T
    left = total - (inverse * gram).sum()
    allowed = left * (1 + MAX_PRUNING_LOSS) ** 2
    while len(kept) > 1:
        # What leaving out joint j adds: the trace of u_j' C_jj^-1 u_j, with C the inverse and u = C times the moments.
        by_joint = inverse.reshape(-1, len(kept), 4)
        own = np.einsum("iaib->iab", inverse.reshape(len(kept), 4, len(kept), 4))
        outer = np.einsum("iaw,wib->iab", (inverse @ gram).reshape(len(kept), 4, -1), by_joint)
        added = np.trace(np.linalg.solve(own, outer), axis1=1, axis2=2)
        least = 1 + int(added[1:].argmin())
        left += added[least]
        if left > allowed:
            break
        gone = 4 * least + np.arange(4)
        inverse = inverse - inverse[:, gone] @ np.linalg.solve(own[least], inverse[gone])
        inverse, gram = (np.delete(np.delete(array, gone, 0), gone, 1) for array in (inverse, gram))
        kept = np.delete(kept, least)
    return kept


def surroundings_of_rig(rig: Rig, partition: Partition, matrices: np.ndarray) -> Surroundings:
    """The joints around a partition of a rig; `matrices` as in `make_surroundings`."""
    center = rig.rest_positions[partition.vertices].mean(axis=0, dtype=np.float64)
    surroundings = make_surroundings(rig.parents, partition, matrices, center, unmoved_joints(rig))
    return replace(surroundings, metres_per_unit=rig.metres_per_unit)


def make_surroundings(
    parents: np.ndarray,
    partition: Partition,
    matrices: np.ndarray,
    center: np.ndarray,
    unmoved: frozenset[int] = frozenset(),
) -> Surroundings:
    """The joints that may move a partition's residuals: those that only influencing joints move against the main one.

    Args:
        parents: (J,) parent index of each joint, -1 for a root.
        partition: with its main joint and the influencing ones.
        matrices: (N, J, 3, 4) skin matrices of all poses, mesh units, or (N, 2 J, 3, 4) with turn matrices behind them
            (`turns.fit_matrices`); any fixed matrices may stand in for the rest pose, the fit takes them up.
        center: (3,) middle of the partition where all skin matrices are the identity, mesh units.
        unmoved: joints that never move.
    """
    influencing, main, count = set(partition.influencing), partition.joint, len(parents)
    between = [joints_between(parents, main, joint) for joint in range(count)]
    # A turn is seen where the joint's parent is, and turns with the joint.
    between += [{joint} | (between[parent] if parent >= 0 else {-1}) for joint, parent in enumerate(parents.tolist())]
    others = [
        number for number in range(matrices.shape[1]) if number != main and between[number] - unmoved <= influencing
    ]
    joints = np.array([main, *others], np.int64)
    moves_along = (joints < count)[:, None]
    apart = matrices[:, joints, :3].astype(np.float64)
    apart[:, :, :, 3] -= moves_along * matrices[:, main, None, :3, 3]
    relative = np.linalg.inv(matrices[:, main, None, :3, :3].astype(np.float64)) @ apart
    relative[:, :, :, 3] += moves_along * (relative[:, :, :, :3] @ center - center)
    return Surroundings(joints, center, relative.transpose(0, 2, 1, 3).reshape(len(matrices), 3, -1))
