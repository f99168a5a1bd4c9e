# SPDX-License-Identifier: GPL-3.0-or-later
"""Principal components of a partition's local residuals, as many as a tolerance requires."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

MAX_POSES = 1000
"""Components are computed from at most this many poses; coefficients from all."""
MAX_COMPONENTS = 128
NEGLIGIBLE_RMS_RATIO = 0.01
"""Part of the rms residual that the components may always leave: networks have far larger errors."""
MAX_ERROR_RATIO = 2.0
"""Upper bound of a partition's error over its allowed error when partitions share the tolerance."""
FINE_TOLERANCE_FACTOR = 4.0
"""Components are allocated from bases that are computed at a tolerance finer by this factor."""
BLOCK_COLUMNS = 1 << 14
"""The Gram matrix is summed over blocks of this many columns, so that float64 needs little memory."""


@dataclass(frozen=True)
class Basis:
    """A basis of residuals: mean + coefficients @ components.

    Attributes:
        mean: (3 Vp,) float32, mesh units.
        components: (K, 3 Vp) float32, orthonormal rows, no unit. K is 0 when the mean alone is within the tolerance.
        truncation_rms: rms distance over poses and vertices that the components leave of the residuals that they were
            computed from, mesh units.
        error_by_count: (K + 1,) float64, the same for the first 0, 1, ... K components.
    """

    mean: np.ndarray
    components: np.ndarray
    truncation_rms: float
    error_by_count: np.ndarray

    def coefficients(self, residuals: np.ndarray) -> np.ndarray:
        """Compute (N, K) float32 coefficients of (N, 3 Vp) residuals, both in mesh units.

        The distance of two rows of coefficients is the distance of the residuals that they represent.
        """
        # (x - mean) @ components.T without a copy of x.
        return (residuals @ self.components.T - self.mean @ self.components.T).astype(np.float32)

    def residuals(self, coefficients: np.ndarray) -> np.ndarray:
        """Compute (N, 3 Vp) float32 residuals from (N, K) coefficients, both in mesh units."""
        return (coefficients @ self.components + self.mean).astype(np.float32)

    def truncated(self, count: int) -> "Basis":
        """Return the basis of the first `count` components."""
        errors = self.error_by_count
        return Basis(self.mean, self.components[:count], float(errors[count]), errors[: count + 1])


def allocate_components(
    errors: Sequence[np.ndarray], vertex_counts: Sequence[int], tolerance: float, units: int
) -> list[int]:
    """Allocate components to partitions so that their common rms error meets the tolerance.

    Each further component goes to the partition where it removes most error per model parameter. Partitions with simple
    residuals get more than their own tolerance requires, those with complex residuals fewer. As in `make_basis`, a
    partition may leave a hundredth of its residual where that is more than the tolerance.

    Args:
        errors: for each partition its `Basis.error_by_count`.
        vertex_counts: of each partition.
        tolerance: rms distance over poses and all vertices that may remain, mesh units.
        units: parameters that a component adds to a network, beside three for each vertex.

    Returns:
        The number of components of each partition.
    """
    allowed_errors = [max(tolerance, NEGLIGIBLE_RMS_RATIO * float(partition_errors[0])) for partition_errors in errors]
    counts, gains = [], []
    for index, (partition_errors, size, allowed) in enumerate(zip(errors, vertex_counts, allowed_errors, strict=True)):
        is_enough = partition_errors <= MAX_ERROR_RATIO * allowed
        counts.append(int(np.argmax(is_enough)) if is_enough.any() else len(partition_errors) - 1)
        removed_squares = size * (partition_errors[:-1] ** 2 - partition_errors[1:] ** 2)[counts[-1] :]
        gains += [(removed / (3 * size + units), index, removed) for removed in removed_squares.tolist()]
    remaining = sum(
        size * float(partition_errors[count]) ** 2
        for partition_errors, size, count in zip(errors, vertex_counts, counts, strict=True)
    )
    goal = sum(size * allowed**2 for size, allowed in zip(vertex_counts, allowed_errors, strict=True))
    # The components of one partition stay in order: each removes no more than the one before it.
    for _, index, removed in sorted(gains, key=lambda gain: -gain[0]):
        if remaining <= goal:
            break
        counts[index] += 1
        remaining -= removed
    return counts


def make_basis(
    residuals: np.ndarray, tolerance: float, rng: np.random.Generator, weights: np.ndarray | None = None
) -> Basis:
    """Compute the principal components that bring the rms error to the tolerance.

    Uses the eigenvectors of the Gram matrix of the poses, or of the covariance of the coordinates where those are
    fewer: a singular value decomposition of the residuals takes longer than the training.

    Args:
        residuals: (N, 3 Vp) float32, the training poses of one partition, mesh units.
        tolerance: rms distance over poses and vertices that may remain, mesh units.
        rng: samples the poses when there are more than `MAX_POSES`.
        weights: (N,) weight of each pose; None for equal weights.
    """
    weights = np.ones(len(residuals)) if weights is None else weights
    mean = _weighted_mean(residuals, weights)
    count, width = residuals.shape
    if count > MAX_POSES and width > MAX_POSES:
        rows = np.sort(rng.choice(count, MAX_POSES, replace=False))
        residuals, weights, count = residuals[rows], weights[rows], MAX_POSES
    use_gram = count <= width
    roots = np.sqrt(weights)[:, None]
    products = np.zeros((min(count, width),) * 2)
    for block in _blocks(width if use_gram else count):
        values = residuals[:, block] if use_gram else residuals[block]
        centered = (values.astype(np.float64) - (mean[block] if use_gram else mean)) * roots[
            slice(None) if use_gram else block
        ]
        products += centered @ centered.T if use_gram else centered.T @ centered
    eigenvalues, eigenvectors = np.linalg.eigh(products)
    eigenvalues, eigenvectors = np.maximum(eigenvalues[::-1], 0), eigenvectors[:, ::-1]
    errors = np.sqrt(np.append(np.cumsum(eigenvalues[::-1])[::-1], 0) / (weights.sum() * width / 3))
    component_count = min(int(np.argmax(errors <= max(tolerance, NEGLIGIBLE_RMS_RATIO * errors[0]))), MAX_COMPONENTS)
    eigenvectors = eigenvectors[:, :component_count]
    if use_gram:
        components = np.empty((width, component_count))
        for block in _blocks(width):
            # Block by block: a product with float64 would make a float64 copy of all residuals.
            components[block] = ((residuals[:, block].astype(np.float64) - mean[block]) * roots).T @ eigenvectors
        eigenvectors = np.linalg.qr(components)[0] if component_count else components
    components = np.ascontiguousarray(eigenvectors.T, np.float32)
    return Basis(mean, components, float(errors[component_count]), errors[: component_count + 1])


def _weighted_mean(residuals: np.ndarray, weights: np.ndarray) -> np.ndarray:
    if (weights == 1).all():
        return residuals.mean(axis=0, dtype=np.float64).astype(np.float32)
    total = np.zeros(residuals.shape[1])
    for block in _blocks(residuals.shape[1]):
        total[block] = weights @ residuals[:, block].astype(np.float64)
    return (total / weights.sum()).astype(np.float32)


def _blocks(length: int) -> list[slice]:
    return [slice(start, start + BLOCK_COLUMNS) for start in range(0, length, BLOCK_COLUMNS)]
