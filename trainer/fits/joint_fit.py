# SPDX-License-Identifier: GPL-3.0-or-later
"""Linear regression of a partition's residuals on the transforms of nearby joints.

Near a joint, smoothing mostly makes vertices follow the joints on both sides partly. This motion is linear in the
joints' transforms, so least squares can fit it. The networks learn the remainder, which is small and smooth. Le and
Lewis, Direct Delta Mush Skinning and Variants, 2019, show how much of delta mush is linear in this sense. For a rig
that preserves volume, half-rotation features are also regressors (`half_rotations`).
"""

from dataclasses import dataclass

import numpy as np

from fdda_addon.core.mathematics.partition import Partition
from fdda_addon.core.rig import STATIC_JOINT, Rig

from ..blocks import block_slices
from .least_squares import add_ridge, solve_ridge

RIDGE = 1e-4
"""Ridge, as a part of the number of poses. Joints that move alike share the fit, so that its factors are small.

With large factors the model is far off as soon as one of these joints moves alone."""
MAX_PRUNING_LOSS = 0.01
"""Joints are removed, the least useful first, as long as the error is at most this part larger than with all joints."""
MIN_EQUATIONS_PER_UNKNOWN = 4
"""Minimum ratio of equations to unknowns of a vertex. With fewer equations the regression explains any residual."""
MIN_SINGULAR_VALUE_RATIO = 1e-5
"""Directions are ignored if their singular value is below this part of the largest one."""


@dataclass(frozen=True)
class JointFit:
    """The fitted part of the residuals of a partition: vertex v moves by sum_j S_j u_vj, with skin matrices S_j.

    The last elements of a vertex's u_vj sum to zero, so that a common motion of all joints has no effect.

    Attributes:
        joints: (Jf,) int64, indices into the regression matrices, the main joint first; may be empty. Index J + j is
            the half-rotation matrix of joint j.
        factors: (4 Jf, Vp) float32, the u_vj joint by joint: three elements in mesh units and one without unit, which
            is 0 for half-rotation matrices.
    """

    joints: np.ndarray
    factors: np.ndarray

    def compute_offsets(self, matrices: np.ndarray) -> np.ndarray:
        """Compute the offsets of the vertices from linear skinning.

        Args:
            matrices: (N, J, 3, 4) or (N, 2 J, 3, 4), as in `joint_regression`.

        Returns:
            (N, Vp, 3) float64, mesh-object space, mesh units.
        """
        rows = matrices[:, self.joints, :3].transpose(0, 2, 1, 3).reshape(len(matrices), 3, -1)
        return (rows.astype(np.float64) @ self.factors).transpose(0, 2, 1)


@dataclass(frozen=True)
class JointRegression:
    """The regressors of a partition's local residuals.

    Attributes:
        joints: (Jf,) int64, the main joint first, half-rotation matrices last, as in `JointFit`.
        center: (3,) float64, center of the partition at rest, mesh-object space, mesh units.
        design: (N, 3, 4 Jf) float64, R_m^-1 S_j of each joint. The last column of each joint is the motion of the
            center, which keeps the regression well conditioned far from the origin.
        size: as in `Rig`; makes the ridge independent of the mesh unit and of the size of the character.
    """

    joints: np.ndarray
    center: np.ndarray
    design: np.ndarray
    size: float

    def main_joint_only(self) -> "JointRegression":
        """Return the regression on the main joint alone, which is constant in its own space."""
        return JointRegression(self.joints[:1], self.center, self.design[:, :, :4], self.size)

    def design_of(self, joints: np.ndarray) -> np.ndarray:
        """Return the (N, 3, 4 n) float64 columns of n of the joints, in the given order."""
        indices = np.argsort(self.joints)[np.searchsorted(np.sort(self.joints), joints)]
        return self.design[:, :, (4 * indices[:, None] + np.arange(4)).ravel()]

    def is_determined(self) -> bool:
        """Return whether there are enough poses for the fit to generalize."""
        poses, _, width = self.design.shape
        return MIN_EQUATIONS_PER_UNKNOWN * width <= 3 * poses

    def column_space(self) -> np.ndarray:
        """Return a (3 N, r) float64 orthonormal basis of the local residuals that the joints explain."""
        flat = self.design.reshape(-1, self.design.shape[2])
        flat = flat / np.maximum(np.linalg.norm(flat, axis=0), np.finfo(np.float64).tiny)
        left_vectors, singular_values, _ = np.linalg.svd(flat, full_matrices=False)
        return left_vectors[:, singular_values > MIN_SINGULAR_VALUE_RATIO * singular_values[0]]

    def fit(self, residuals: np.ndarray, training: np.ndarray) -> tuple[JointFit, np.ndarray]:
        """Fit local residuals by ridge regression, and remove joints that hardly help.

        Args:
            residuals: (N, Vp, 3) float32 local residuals, mesh units.
            training: indices of the poses to fit.

        Returns:
            The fit, and the (N, Vp, 3) float32 remainder of the residuals of all poses, mesh units.
        """
        width = self.design.shape[2]
        gram, moments = np.zeros((width, width)), np.zeros((width, residuals.shape[1]))
        total = 0.0
        for block in block_slices(len(training), residuals[0].size):
            poses = training[block]
            rows = self.design[poses].reshape(-1, width)
            gram += rows.T @ rows
            values = residuals[poses].transpose(0, 2, 1).reshape(len(rows), -1).astype(np.float64)
            moments += rows.T @ values
            total += (values**2).sum()
        ridge = np.ones(width)
        ridge[3::4] *= self.size**2
        ridge *= RIDGE * len(training)
        # Hardly any for the main joint: its part is the mean of the residuals, which no other joint can share.
        ridge[:4] *= 1e-2
        selected = _select_joints(add_ridge(gram, ridge), moments, total)
        columns = (4 * selected[:, None] + np.arange(4)).ravel()
        solution = solve_ridge(gram[np.ix_(columns, columns)], moments[columns], ridge[columns])
        remaining = np.empty_like(residuals)
        for poses in block_slices(len(residuals), residuals[0].size):
            remaining[poses] = residuals[poses] - (self.design[poses][:, :, columns] @ solution).transpose(0, 2, 1)
        return JointFit(self.joints[selected], self._factors(solution.reshape(len(selected), 4, -1))), remaining

    def _factors(self, solution: np.ndarray) -> np.ndarray:
        """Convert factors (Jf, 4, Vp) of the design matrix to factors (4 Jf, Vp) of the skin matrices."""
        factors, last_elements = solution.copy(), solution[:, 3]
        factors[0, 3] = 0
        factors[1:, :3] += self.center[:, None] * last_elements[1:, None]
        total = last_elements[1:].sum(axis=0)
        factors[0, :3] -= self.center[:, None] * total
        factors[0, 3] -= total
        return factors.reshape(-1, solution.shape[2]).astype(np.float32)


def _select_joints(gram: np.ndarray, moments: np.ndarray, total: float) -> np.ndarray:
    """Select the joints of the fit by backward elimination.

    Args:
        gram, moments: (4 Jf, 4 Jf) and (4 Jf, Vp) of the normal equations, the ridge included.
        total: sum of the squared residuals.

    Returns:
        Ascending indices; the first joint is always selected.
    """
    selected = np.arange(len(gram) // 4)
    inverse, moment_gram = np.linalg.inv(gram), moments @ moments.T
    error = total - (inverse * moment_gram).sum()
    max_error = error * (1 + MAX_PRUNING_LOSS) ** 2
    while len(selected) > 1:
        # Removing joint j adds the trace of u_j' C_jj^-1 u_j, with C the inverse and u = C times the moments.
        by_joint = inverse.reshape(-1, len(selected), 4)
        diagonal = np.einsum("iaib->iab", inverse.reshape(len(selected), 4, len(selected), 4))
        outer = np.einsum("iaw,wib->iab", (inverse @ moment_gram).reshape(len(selected), 4, -1), by_joint)
        added_errors = np.trace(np.linalg.solve(diagonal, outer), axis1=1, axis2=2)
        least_useful = 1 + int(added_errors[1:].argmin())
        error += added_errors[least_useful]
        if error > max_error:
            break
        removed = 4 * least_useful + np.arange(4)
        inverse = inverse - inverse[:, removed] @ np.linalg.solve(diagonal[least_useful], inverse[removed])
        inverse, moment_gram = (np.delete(np.delete(array, removed, 0), removed, 1) for array in (inverse, moment_gram))
        selected = np.delete(selected, least_useful)
    return selected


def joint_regression(rig: Rig, partition: Partition, matrices: np.ndarray) -> JointRegression:
    """Create the regression on all joints whose motion relative to the main joint depends on influencing joints alone.

    Args:
        rig, partition: the rig, and a partition of it.
        matrices: (N, J, 3, 4) skin matrices of all poses, mesh units, or (N, 2 J, 3, 4) followed by half-rotation
            matrices (`half_rotations.regression_matrices`). The rest pose may be any fixed pose.
    """
    references, center = rig.references, rig.rest_positions[partition.vertices].mean(axis=0, dtype=np.float64)
    # The static joint never moves, so it influences nothing.
    static = {index for index, name in enumerate(rig.joint_names) if name == STATIC_JOINT}
    influencing, main, count = set(partition.influencing), partition.joint, len(references)
    paths = [joints_on_path(references, main, joint) for joint in range(count)]
    # A half rotation is in the space of the reference joint, and depends on the joint.
    paths += [{joint} | (paths[reference] if reference >= 0 else {-1}) for joint, reference in enumerate(references)]
    others = [index for index in range(matrices.shape[1]) if index != main and paths[index] - static <= influencing]
    joints = np.array([main, *others], np.int64)
    is_skin = (joints < count)[:, None]
    relative = matrices[:, joints, :3].astype(np.float64)
    relative[:, :, :, 3] -= is_skin * matrices[:, main, None, :3, 3]
    local = np.linalg.inv(matrices[:, main, None, :3, :3].astype(np.float64)) @ relative
    local[:, :, :, 3] += is_skin * (local[:, :, :, :3] @ center - center)
    return JointRegression(joints, center, local.transpose(0, 2, 1, 3).reshape(len(matrices), 3, -1), rig.size)


def joints_on_path(references: np.ndarray, first: int, second: int) -> set[int]:
    """Return the joints whose transforms relative to their reference joints compose that of one joint in another's.

    Without a common reference joint, these are all joints from either one up to mesh-object space.
    """
    chains: tuple[set[int], set[int]] = set(), set()
    for chain, joint in zip(chains, (first, second), strict=True):
        while joint >= 0:
            chain.add(joint)
            joint = int(references[joint])
    return chains[0] ^ chains[1]
