# SPDX-License-Identifier: GPL-3.0-or-later
"""Basis shapes of the local residuals of a partition: principal components, as many as a tolerance asks for."""

from dataclasses import dataclass

import numpy as np

MAX_POSES = 1000
"""The components come from at most this many poses; the coefficients from all."""
MAX_SHAPES = 128
NEGLIGIBLE = 0.01
"""Part of the rms residual that shapes need not hold, whatever the tolerance: networks err far more than that."""
COLUMN_BLOCK = 1 << 14
"""The Gram matrix is summed up over blocks of this many columns, so that float64 costs little memory."""


@dataclass(frozen=True)
class Basis:
    """Residuals as mean + coefficients @ shapes.

    Attributes:
        mean: (3 Vp,) float32, mesh units.
        shapes: (K, 3 Vp) float32, orthonormal rows, no unit. K is 0 when the mean alone is within the tolerance.
        truncation: rms distance over poses and vertices that the shapes leave of the residuals they were made of,
            mesh units.
    """

    mean: np.ndarray
    shapes: np.ndarray
    truncation: float

    def coefficients(self, residuals: np.ndarray) -> np.ndarray:
        """(N, 3 Vp) residuals to (N, K) float32 coefficients, both in mesh units.

        The distance of two rows of coefficients is the distance of the residuals that they stand for.
        """
        # (x - mean) @ shapes.T without a copy of x that is as large as x.
        return (residuals @ self.shapes.T - self.mean @ self.shapes.T).astype(np.float32)

    def residuals(self, coefficients: np.ndarray) -> np.ndarray:
        """(N, K) coefficients to (N, 3 Vp) float32 residuals, both in mesh units."""
        return (coefficients @ self.shapes + self.mean).astype(np.float32)


def make_basis(residuals: np.ndarray, tolerance: float, rng: np.random.Generator) -> Basis:
    """Find the basis shapes that bring the rms distance to the tolerance.

    Principal components through the Gram matrix of the poses, or through the covariance of the coordinates where
    those are fewer; a singular value decomposition of the residuals costs more than the training.

    Args:
        residuals: (N, 3 Vp) float32, the training poses of one partition, mesh units.
        tolerance: rms distance over poses and vertices that may remain, mesh units.
        rng: chooses the poses when there are more than `MAX_POSES`.
    """
    mean = residuals.mean(axis=0, dtype=np.float64).astype(np.float32)
    count, width = residuals.shape
    if count > MAX_POSES and width > MAX_POSES:
        rows = np.sort(rng.choice(count, MAX_POSES, replace=False))
        residuals, count = residuals[rows], MAX_POSES
    by_pose = count <= width
    products = np.zeros((min(count, width),) * 2)
    for block in _blocks(width if by_pose else count):
        part = residuals[:, block] if by_pose else residuals[block]
        centred = part.astype(np.float64) - (mean[block] if by_pose else mean)
        products += centred @ centred.T if by_pose else centred.T @ centred
    values, vectors = np.linalg.eigh(products)
    values, vectors = np.maximum(values[::-1], 0), vectors[:, ::-1]
    # What is left after the first k components, as an rms over poses and vertices.
    left = np.sqrt(np.append(np.cumsum(values[::-1])[::-1], 0) / (count * width / 3))
    shapes_needed = min(int(np.argmax(left <= max(tolerance, NEGLIGIBLE * left[0]))), MAX_SHAPES)
    vectors = vectors[:, :shapes_needed]
    if by_pose:
        shapes = np.empty((width, shapes_needed))
        for block in _blocks(width):
            # Block by block: a product with float64 would make a float64 copy of all residuals.
            shapes[block] = (residuals[:, block].astype(np.float64) - mean[block]).T @ vectors
        vectors = np.linalg.qr(shapes)[0] if shapes_needed else shapes
    return Basis(mean, np.ascontiguousarray(vectors.T, np.float32), float(left[shapes_needed]))


def _blocks(length: int) -> list[slice]:
    return [slice(start, start + COLUMN_BLOCK) for start in range(0, length, COLUMN_BLOCK)]
