# SPDX-License-Identifier: GPL-3.0-or-later
"""Principal components of a partition's local residuals. A tolerance determines the number of components."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdda_addon.core.mathematics.blocks import block_slices

MAX_POSES = 1000
"""Maximum number of poses from which components are computed. Coefficients are then computed for all poses."""
MAX_COMPONENTS = 128
NEGLIGIBLE_RMS_RATIO = 0.01
"""Error that the components may always leave, as a part of the rms residual. Networks have far larger errors."""
MAX_ERROR_RATIO = 2.0
"""Maximum ratio of a partition's error to its allowed error when partitions share the tolerance."""
FINE_TOLERANCE_FACTOR = 4.0
"""Factor by which the tolerance is divided to compute the bases from which components are allocated."""


@dataclass(frozen=True)
class Basis:
    """A basis of residuals: mean + coefficients @ components.

    Attributes:
        mean: (3 Vp,) float32, mesh units.
        components: (K, 3 Vp) float32, orthonormal rows, no unit. K is 0 when the mean alone is within the tolerance.
        error_by_count: (K + 1,) float64, rms distance over poses and vertices between the residuals and their
            approximation by the first 0, 1, ... K components, mesh units.
    """

    mean: np.ndarray
    components: np.ndarray
    error_by_count: np.ndarray

    @property
    def truncation_rms(self) -> float:
        """The error of all components, mesh units."""
        return float(self.error_by_count[-1])

    def project(self, residuals: np.ndarray) -> np.ndarray:
        """Compute (N, K) float32 coefficients of (N, 3 Vp) residuals, both in mesh units.

        The distance between two rows of coefficients equals the distance between the residuals that they represent.
        """
        # This equals (residuals - mean) @ components.T, but makes no copy of the residuals.
        return (residuals @ self.components.T - self.mean @ self.components.T).astype(np.float32)

    def reconstruct(self, coefficients: np.ndarray) -> np.ndarray:
        """Compute (N, 3 Vp) float32 residuals from (N, K) coefficients, both in mesh units."""
        return (coefficients @ self.components + self.mean).astype(np.float32)

    def truncate(self, count: int) -> "Basis":
        """Return the basis of the first `count` components."""
        return Basis(self.mean, self.components[:count], self.error_by_count[: count + 1])


def allocate_components(
    errors: Sequence[np.ndarray], vertex_counts: Sequence[int], tolerance: float, parameters_per_component: int
) -> list[int]:
    """Allocate components to partitions so that their common rms error meets the tolerance.

    Each further component goes to the partition where it removes most error per model parameter. Partitions with simple
    residuals get more components than the tolerance requires of them alone, and partitions with complex residuals get
    fewer. As in `make_basis`, the error of a partition may always be a hundredth of its residual.

    Args:
        errors: for each partition its `Basis.error_by_count`.
        vertex_counts: number of vertices of each partition.
        tolerance: allowed rms error over poses and all vertices, mesh units.
        parameters_per_component: parameters that a component adds to a network, besides three for each vertex.

    Returns:
        The number of components of each partition.
    """
    allowed_errors = [max(tolerance, NEGLIGIBLE_RMS_RATIO * float(partition_errors[0])) for partition_errors in errors]
    counts, gains = [], []
    partitions = list(zip(errors, vertex_counts, allowed_errors, strict=True))
    for index, (partition_errors, vertex_count, allowed_error) in enumerate(partitions):
        is_allowed = partition_errors <= MAX_ERROR_RATIO * allowed_error
        counts.append(int(np.argmax(is_allowed)) if is_allowed.any() else len(partition_errors) - 1)
        removed_squares = vertex_count * (partition_errors[:-1] ** 2 - partition_errors[1:] ** 2)[counts[-1] :]
        gains += [
            (removed_square / (3 * vertex_count + parameters_per_component), index, removed_square)
            for removed_square in removed_squares.tolist()
        ]
    remaining_squares = sum(n * float(e[count]) ** 2 for (e, n, _), count in zip(partitions, counts, strict=True))
    allowed_squares = sum(vertex_count * allowed_error**2 for _, vertex_count, allowed_error in partitions)
    # The components of one partition are added in order, because each removes at most as much as the one before it.
    for _, index, removed_square in sorted(gains, key=lambda gain: -gain[0]):
        if remaining_squares <= allowed_squares:
            break
        counts[index] += 1
        remaining_squares -= removed_square
    return counts


def make_basis(
    residuals: np.ndarray, tolerance: float, rng: np.random.Generator, weights: np.ndarray | None = None
) -> Basis:
    """Compute as many principal components as the tolerance of the rms error requires.

    Uses the eigenvectors of the Gram matrix of the poses, or of the covariance matrix of the coordinates where there
    are fewer coordinates than poses. A singular value decomposition of the residuals takes longer than the training.

    Args:
        residuals: (N, 3 Vp) float32, residuals of one partition in the training poses, mesh units.
        tolerance: allowed rms error over poses and vertices, mesh units.
        rng: samples the poses when there are more than `MAX_POSES`.
        weights: (N,) weight of each pose; None for equal weights.
    """
    weights = np.ones(len(residuals)) if weights is None else weights
    mean = _weighted_mean(residuals, weights)
    pose_count, coordinate_count = residuals.shape
    if pose_count > MAX_POSES and coordinate_count > MAX_POSES:
        sampled_poses = np.sort(rng.choice(pose_count, MAX_POSES, replace=False))
        residuals, weights, pose_count = residuals[sampled_poses], weights[sampled_poses], MAX_POSES
    use_gram = pose_count <= coordinate_count
    weight_roots = np.sqrt(weights)[:, None]
    gram_matrix = np.zeros((min(pose_count, coordinate_count),) * 2)
    for block in block_slices(*residuals.shape[::-1] if use_gram else residuals.shape):
        block_values = residuals[:, block] if use_gram else residuals[block]
        centered = (block_values.astype(np.float64) - (mean[block] if use_gram else mean)) * weight_roots[
            slice(None) if use_gram else block
        ]
        gram_matrix += centered @ centered.T if use_gram else centered.T @ centered
    eigenvalues, eigenvectors = np.linalg.eigh(gram_matrix)
    eigenvalues, eigenvectors = np.maximum(eigenvalues[::-1], 0), eigenvectors[:, ::-1]
    error_by_count = np.sqrt(np.append(np.cumsum(eigenvalues[::-1])[::-1], 0) / (weights.sum() * coordinate_count / 3))
    component_count = min(
        int(np.argmax(error_by_count <= max(tolerance, NEGLIGIBLE_RMS_RATIO * error_by_count[0]))), MAX_COMPONENTS
    )
    eigenvectors = eigenvectors[:, :component_count]
    if use_gram:
        components = np.empty((coordinate_count, component_count))
        for block in block_slices(coordinate_count, pose_count):
            # Block by block, because a product with float64 makes a float64 copy of all residuals.
            components[block] = ((residuals[:, block].astype(np.float64) - mean[block]) * weight_roots).T @ eigenvectors
        eigenvectors = np.linalg.qr(components)[0] if component_count else components
    components = np.ascontiguousarray(eigenvectors.T, np.float32)
    return Basis(mean, components, error_by_count[: component_count + 1])


def _weighted_mean(residuals: np.ndarray, weights: np.ndarray) -> np.ndarray:
    if (weights == 1).all():
        return residuals.mean(axis=0, dtype=np.float64).astype(np.float32)
    total = np.zeros(residuals.shape[1])
    for block in block_slices(*residuals.shape[::-1]):
        total[block] = weights @ residuals[:, block].astype(np.float64)
    return (total / weights.sum()).astype(np.float32)
