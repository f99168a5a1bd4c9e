# SPDX-License-Identifier: GPL-3.0-or-later
"""Linear regression of a partition's residuals on the transforms of nearby joints and on the values of shape keys.

Near a joint, smoothing mostly makes vertices follow the joints on both sides partly. This motion is linear in the
joints' transforms, so least squares can fit it. The networks learn the remainder, which is small and smooth. Le and
Lewis, Direct Delta Mush Skinning and Variants, 2019, show how much of delta mush is linear in this sense. For a rig
that preserves volume, half-rotation features are also regressors (`half_rotations`).

A shape key moves vertices in proportion to its value, before joints and smoothing move them on. In the space of the
main joint this is nearly linear in the value, in any range.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from fdda_addon.core.mathematics.blocks import block_slices
from fdda_addon.core.mathematics.partition import Partition
from fdda_addon.core.rig import STATIC_JOINT, Rig

RIDGE = 1e-4
"""Ridge, as a part of the number of poses. Joints that move alike share the fit, so that its factors are small.

With large factors the model is far off as soon as one of these joints moves alone."""
MAX_PRUNING_LOSS = 0.01
"""Joints are removed, the least useful first, as long as the error is at most this part larger than with all joints."""
MIN_EQUATIONS_PER_UNKNOWN = 4
"""Minimum ratio of equations to unknowns of a vertex. With fewer equations the regression explains any residual."""
MIN_SINGULAR_VALUE_RATIO = 1e-5
"""Directions are ignored if their singular value is below this part of the largest one."""
CONTROL_RIDGE = 1e-5
"""Ridge of a shape key, as a part of the number of poses times the variance of its value."""
MIN_SIGNIFICANCE = 5.0
"""A shape key is in the fit if it moves a vertex by more than this many standard errors of the fit."""


@dataclass(frozen=True)
class JointFit:
    """The fitted part of the residuals of a partition.

    Vertex v moves by sum_j S_j u_vj, with skin matrices S_j, and in the space of the main joint by sum_k s_k e_kv, with
    values s_k of shape keys.

    The last elements of a vertex's u_vj sum to zero, so that a common motion of all joints has no effect.

    Attributes:
        joints: (Jf,) int64, indices into the regression matrices, the main joint first; may be empty. Index J + j is
            the half-rotation matrix of joint j.
        factors: (4 Jf, Vp) float32, the u_vj joint by joint: three elements in mesh units and one without unit, which
            is 0 for half-rotation matrices.
        controls: (S,) int64, indices of the shape keys among the controls of the rig, ascending.
        control_factors: (3 S, Vp) float32, the e_kv key by key, mesh units per unit of the key.
    """

    joints: np.ndarray
    factors: np.ndarray
    controls: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    control_factors: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), np.float32))

    def compute_offsets(self, matrices: np.ndarray) -> np.ndarray:
        """Compute the offsets of the vertices from linear skinning.

        Args:
            matrices: (N, J, 3, 4) or (N, 2 J, 3, 4), as in `joint_regression`.

        Returns:
            (N, Vp, 3) float64, mesh-object space, mesh units.
        """
        rows = matrices[:, self.joints, :3].transpose(0, 2, 1, 3).reshape(len(matrices), 3, -1)
        return (rows.astype(np.float64) @ self.factors).transpose(0, 2, 1)

    def compute_key_residuals(self, controls: np.ndarray) -> np.ndarray:
        """Compute the (N, Vp, 3) float64 local residuals of shape keys, mesh units, from (N, C) values of controls."""
        values = controls[:, self.controls].astype(np.float64)
        by_axis = values @ self.control_factors.reshape(len(self.controls), 3 * self.factors.shape[1])
        return by_axis.reshape(len(values), 3, -1).transpose(0, 2, 1)


@dataclass(frozen=True)
class JointRegression:
    """The regressors of a partition's local residuals.

    Attributes:
        joints: (Jf,) int64, the main joint first, half-rotation matrices last, as in `JointFit`.
        center: (3,) float64, center of the partition at rest, mesh-object space, mesh units.
        design: (N, 3, 4 Jf) float64, R_m^-1 S_j of each joint. The last column of each joint is the motion of the
            center, which keeps the regression well conditioned far from the origin.
        size: as in `Rig`; makes the ridge independent of the mesh unit and of the size of the character.
        controls: (S,) int64, the shape keys, as in `JointFit`.
        control_values: (N, S) float64, their values.
    """

    joints: np.ndarray
    center: np.ndarray
    design: np.ndarray
    size: float
    controls: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    control_values: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))

    def main_joint_only(self) -> "JointRegression":
        """Return the regression on the main joint alone, which is constant in its own space."""
        return replace(self, joints=self.joints[:1], design=self.design[:, :, :4])

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

    def key_rows(self, controls: np.ndarray, poses: np.ndarray | slice) -> np.ndarray:
        """Return the (n, 3, 3 s) float64 columns of s of the shape keys in n poses: their values for each axis."""
        values = self.control_values[poses][:, np.searchsorted(self.controls, controls)]
        return np.einsum("nk,ab->nakb", values, np.eye(3)).reshape(len(values), 3, -1)

    def fit(self, residuals: np.ndarray, training: np.ndarray, min_effect: float = 0.0) -> tuple[JointFit, np.ndarray]:
        """Fit local residuals by ridge regression, and remove the joints and shape keys that hardly help.

        Args:
            residuals: (N, Vp, 3) float32 local residuals, mesh units.
            training: indices of the poses to fit.
            min_effect: a shape key that moves no vertex by more, over its range, is left out, mesh units.

        Returns:
            The fit, and the (N, Vp, 3) float32 remainder of the residuals of all poses, mesh units.
        """
        joint_width = self.design.shape[2]
        width, vertex_count = joint_width + 3 * len(self.controls), residuals.shape[1]
        gram, moments = np.zeros((width, width)), np.zeros((width, vertex_count))
        total, squares = 0.0, np.zeros(vertex_count)
        for block in block_slices(len(training), residuals[0].size):
            poses = training[block]
            rows = self.design[poses]
            if len(self.controls):
                rows = np.concatenate([rows, self.key_rows(self.controls, poses)], axis=2)
            rows = rows.reshape(-1, width)
            gram += rows.T @ rows
            values = residuals[poses].transpose(0, 2, 1).reshape(len(rows), -1).astype(np.float64)
            moments += rows.T @ values
            total += (values**2).sum()
            squares += np.einsum("nv,nv->v", values, values) if len(self.controls) else 0.0
        ridge = np.ones(width)
        ridge[3:joint_width:4] *= self.size**2
        ridge *= RIDGE * len(training)
        # Hardly any for the main joint: its part is the mean of the residuals, which no other joint can share.
        ridge[:4] *= 1e-2
        selected_keys = np.zeros(0, np.int64)
        joint_gram, joint_moments = add_ridge(gram, ridge), moments
        if len(self.controls):
            variances = self.control_values[training].var(axis=0)
            ridge[joint_width:] = np.repeat(CONTROL_RIDGE * len(training) * np.maximum(variances, 1e-12), 3)
            joint_gram, joint_moments, eliminated, selected_keys = self._eliminate_keys(
                add_ridge(gram, ridge), moments, squares, training, min_effect
            )
            total -= eliminated
        selected = _select_joints(joint_gram, joint_moments, total)
        columns = (4 * selected[:, None] + np.arange(4)).ravel()
        key_columns = joint_width + (3 * selected_keys[:, None] + np.arange(3)).ravel()
        all_columns = np.append(columns, key_columns)
        solution = solve_ridge(gram[np.ix_(all_columns, all_columns)], moments[all_columns], ridge[all_columns])
        solution, key_solution = solution[: len(columns)], solution[len(columns) :]
        controls, remaining = self.controls[selected_keys], np.empty_like(residuals)
        for poses in block_slices(len(residuals), residuals[0].size):
            explained = self.design[poses][:, :, columns] @ solution
            if len(controls):
                explained += self.key_rows(controls, poses) @ key_solution
            remaining[poses] = residuals[poses] - explained.transpose(0, 2, 1)
        factors = self._factors(solution.reshape(len(selected), 4, -1))
        return JointFit(self.joints[selected], factors, controls, key_solution.astype(np.float32)), remaining

    def _eliminate_keys(
        self, gram: np.ndarray, moments: np.ndarray, squares: np.ndarray, training: np.ndarray, min_effect: float
    ) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
        """Select the shape keys of the fit, and eliminate them from the normal equations.

        Args:
            gram, moments: of joints and all keys, the ridge included.
            squares: (Vp,) sums of the squared residuals.
            training, min_effect: as in `fit`.

        Returns:
            Gram matrix and moments of the joints, the squares that the keys explain, and indices of the selected keys.
        """
        joint_width, ranges = self.design.shape[2], np.ptp(self.control_values[training], axis=0)
        inverse = np.linalg.inv(gram)
        solution = inverse @ moments
        degrees_of_freedom = max(1, 3 * len(training) - len(gram))
        variances = np.maximum(squares - np.einsum("wv,wv->v", solution, moments), 0) / degrees_of_freedom
        effects = np.linalg.norm(solution[joint_width:].reshape(len(ranges), 3, -1), axis=1)
        key_variances = np.diag(inverse)[joint_width:].reshape(-1, 3).sum(axis=1)
        min_effects = MIN_SIGNIFICANCE * np.sqrt(key_variances[:, None] * variances)
        is_selected = ((effects > min_effects) & (effects * ranges[:, None] > min_effect)).any(axis=1)
        columns = joint_width + (3 * np.flatnonzero(is_selected)[:, None] + np.arange(3)).ravel()
        joints = slice(joint_width)
        carried = np.linalg.solve(
            gram[np.ix_(columns, columns)], np.concatenate([gram[columns, joints], moments[columns]], axis=1)
        )
        crossed = gram[joints, columns] @ carried
        return (
            gram[joints, joints] - crossed[:, joints],
            moments[joints] - crossed[:, joint_width:],
            float((moments[columns] * carried[:, joint_width:]).sum()),
            np.flatnonzero(is_selected),
        )

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


def joint_regression(
    rig: Rig, partition: Partition, matrices: np.ndarray, controls: np.ndarray | None = None
) -> JointRegression:
    """Create the regression on shape keys, and on all joints whose motion in the main joint's space is an influence.

    Joints are those whose motion relative to the main joint depends on influencing joints alone.

    Args:
        rig, partition: the rig, and a partition of it.
        matrices: (N, J, 3, 4) skin matrices of all poses, mesh units, or (N, 2 J, 3, 4) followed by half-rotation
            matrices (`half_rotations.regression_matrices`). The rest pose may be any fixed pose.
        controls: (N, C) values of the controls; None for a regression without shape keys.
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
    design, keys = local.transpose(0, 2, 1, 3).reshape(len(matrices), 3, -1), np.zeros(0, np.int64)
    if controls is not None and len(partition.controls):
        keys = np.array([c for c in partition.controls if rig.controls[c].is_shape_key], np.int64)
        keys = keys[np.ptp(controls[:, keys], axis=0) > 0]
    values = controls[:, keys].astype(np.float64) if len(keys) else np.zeros((len(matrices), 0))
    return JointRegression(joints, center, design, rig.size, keys, values)


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


def add_ridge(gram: np.ndarray, ridge: np.ndarray | float) -> np.ndarray:
    """Add a ridge, one value or (n,) values, to the diagonal of an (n, n) Gram matrix; returns float64."""
    return gram + np.diag(np.broadcast_to(np.asarray(ridge, np.float64), len(gram)))


def solve_ridge(gram: np.ndarray, moments: np.ndarray, ridge: np.ndarray | float) -> np.ndarray:
    """Minimize |A x - b|^2 + sum_i ridge_i x_i^2 (Tikhonov regularization).

    Args:
        gram: (n, n) A' A, or a kernel matrix.
        moments: (n, m) or (n,) A' b, or the values of the kernel's samples.
        ridge: one value or (n,) values, above 0 where the Gram matrix is singular.

    Returns:
        x, float64, in the shape of `moments`.
    """
    return np.linalg.solve(add_ridge(gram, ridge), moments)
