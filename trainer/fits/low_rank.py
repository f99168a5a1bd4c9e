# SPDX-License-Identifier: GPL-3.0-or-later
"""Low-rank factors of a large partition: fewer parameters per vertex for everything but linear skinning.

A joint of the fit has four parameters per vertex, a component three, and many of them are nearly dependent: the fit and
the components of an elbow affect the same vertices. So the matrix of all joints and components is replaced by the
product of a small matrix and a few vertex factors with one parameter per vertex each. The product is the truncated
singular value decomposition of the matrix, weighted by the training poses.
"""

from dataclasses import dataclass, replace

import numpy as np

from .basis import Basis
from .joint_fit import JointFit, JointRegression

TOLERANCE_RATIO = 0.1
"""Maximum error of the factorization, as a part of the tolerance of the basis."""
PRODUCT_PARAMETERS = 6_000
"""Cost of one more matrix product, as the number of constants that are read in the same time."""


@dataclass(frozen=True)
class LowRankFactors:
    """The factorized fit and basis of a partition.

    Attributes:
        vertex_factors: (r, Vp) float32, orthonormal rows, no unit.
        fit, basis: fit and basis, projected to the span of the vertex factors.
        change_of_basis: (K', K) float64, converts coefficients of the former basis to coefficients of this basis.
        error_rms: rms distance over training poses and vertices from the unfactorized fit and basis, mesh units.
    """

    vertex_factors: np.ndarray
    fit: JointFit
    basis: Basis
    change_of_basis: np.ndarray
    error_rms: float


def may_factorize(fit: JointFit, basis: Basis) -> bool:
    """Return whether a partition is large enough for a factorization to save parameters."""
    return len(fit.joints) > 0 and _row_count(fit, basis) * fit.factors.shape[1] >= 2 * PRODUCT_PARAMETERS


def factorize(
    fit: JointFit,
    basis: Basis,
    coefficients: np.ndarray,
    regression: JointRegression,
    training: np.ndarray,
    weights: np.ndarray,
    tolerance: float,
) -> LowRankFactors | None:
    """Factorize the fit and the basis of a partition.

    Args:
        fit, basis: fit and basis of the partition.
        coefficients: (N, K) coefficients of all poses, mesh units.
        regression: regression whose result is the fit.
        training: indices of the training poses.
        weights: weights of the training poses.
        tolerance: rms error over poses and vertices that the components may leave, mesh units.

    Returns:
        The factors; None if they save fewer parameters than one more product costs.
    """
    row_count, vertex_count = _row_count(fit, basis), fit.factors.shape[1]
    design = regression.design_of(fit.joints)[training]
    if len(fit.controls):
        design = np.concatenate([design, regression.key_rows(fit.controls, training)], axis=2)
    inputs = _inputs(design, coefficients[training], weights)
    eigenvalues, eigenvectors = np.linalg.eigh(inputs.T @ inputs)
    root = (np.sqrt(np.maximum(eigenvalues, 0)) * eigenvectors).T
    weighted = root @ _stacked_factors(fit, basis, regression.center)
    squares, eigenvectors = np.linalg.eigh(weighted @ weighted.T)
    squares, eigenvectors = np.maximum(squares[::-1], 0), eigenvectors[:, ::-1]
    errors = np.sqrt(np.append(np.cumsum(squares[::-1])[::-1], 0) / (weights.sum() * vertex_count))
    rank = int(np.argmax(errors <= TOLERANCE_RATIO * tolerance))
    if rank * (row_count + vertex_count) + PRODUCT_PARAMETERS > row_count * vertex_count:
        return None
    vertex_factors = np.linalg.qr(weighted.T @ eigenvectors[:, :rank])[0].T.astype(np.float32)
    fit = replace(fit, factors=_project(fit.factors, vertex_factors))
    if len(fit.controls):
        fit = replace(fit, control_factors=_project(fit.control_factors, vertex_factors))
    error = float(errors[rank])
    return LowRankFactors(vertex_factors, fit, *_projected_basis(vertex_factors, basis, error), error)


def _project(factors: np.ndarray, vertex_factors: np.ndarray) -> np.ndarray:
    """Project (n, Vp) factors to the span of the vertex factors; returns float32."""
    return ((factors @ vertex_factors.T.astype(np.float64)) @ vertex_factors).astype(np.float32)


def _row_count(fit: JointFit, basis: Basis) -> int:
    return len(fit.factors) + len(fit.control_factors) + 3 * len(basis.components)


def _inputs(design: np.ndarray, coefficients: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return (3 N, 4 Jf + 3 S + 3 K) float64, what multiplies a vertex's parameters, in the main joint's space."""
    by_axis = np.einsum("nk,ab->nakb", coefficients.astype(np.float64), np.eye(3))
    rows = np.concatenate([design, by_axis.reshape(len(design), 3, 3 * coefficients.shape[1])], axis=2)
    return (rows * np.sqrt(weights)[:, None, None]).reshape(3 * len(rows), -1)


def _stacked_factors(fit: JointFit, basis: Basis, center: np.ndarray) -> np.ndarray:
    """Return (4 Jf + 3 S + 3 K, Vp) float64 parameters of vertices; the mean is part of those of the main joint."""
    vertex_count, component_count = fit.factors.shape[1], len(basis.components)
    factors = fit.factors.reshape(-1, 4, vertex_count).astype(np.float64)
    factors[:, :3] -= center[:, None] * factors[:, 3:]
    factors[0, :3] += basis.mean.reshape(vertex_count, 3).T
    components = _by_axis(basis.components, vertex_count).reshape(3 * component_count, vertex_count)
    keys = fit.control_factors.reshape(3 * len(fit.controls), vertex_count)
    return np.concatenate([factors.reshape(-1, vertex_count), keys, components])


def _projected_basis(vertex_factors: np.ndarray, basis: Basis, error: float) -> tuple[Basis, np.ndarray]:
    """Project a basis to the span of the vertex factors, orthonormalize it, and return it with the change of basis."""
    vertex_count, vertex_factors = vertex_factors.shape[1], vertex_factors.astype(np.float64)
    mean = _by_axis(basis.mean[None], vertex_count)[0] @ vertex_factors.T @ vertex_factors
    components = _by_axis(basis.components, vertex_count) @ vertex_factors.T
    rank = len(vertex_factors)
    orthonormal, change_of_basis = np.linalg.qr(components.reshape(len(components), 3 * rank).T)
    count = orthonormal.shape[1]
    components = orthonormal.T.reshape(count, 3, rank) @ vertex_factors
    components = components.transpose(0, 2, 1).reshape(count, 3 * vertex_count)
    projected = Basis(
        mean.T.reshape(-1).astype(np.float32),
        np.ascontiguousarray(components, np.float32),
        np.hypot(np.append(basis.error_by_count[:count], basis.truncation_rms), error),
    )
    return projected, change_of_basis


def _by_axis(components: np.ndarray, vertex_count: int) -> np.ndarray:
    """Convert (K, 3 Vp) to (K, 3, Vp) float64."""
    return components.reshape(len(components), vertex_count, 3).transpose(0, 2, 1).astype(np.float64)
