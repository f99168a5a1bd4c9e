# SPDX-License-Identifier: GPL-3.0-or-later
"""Basis shapes of the local residuals of a partition: principal components, as many as a tolerance asks for."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

MAX_POSES = 1000
"""The components come from at most this many poses; the coefficients from all."""
MAX_SHAPES = 128
NEGLIGIBLE = 0.01
"""Part of the rms residual that shapes need not hold, whatever the tolerance: networks err far more than that."""
WORST = 2.0
"""Where partitions share their shapes, none is left with more than this many times what each may leave on average."""
FINER = 4.0
"""Shapes are shared out of those that each partition would have at a tolerance so many times finer."""
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
        left: (K + 1,) float64, the same by number of shapes: of none, of the first, ... of all of them.
    """

    mean: np.ndarray
    shapes: np.ndarray
    truncation: float
    left: np.ndarray

    def coefficients(self, residuals: np.ndarray) -> np.ndarray:
        """(N, 3 Vp) residuals to (N, K) float32 coefficients, both in mesh units.

        The distance of two rows of coefficients is the distance of the residuals that they stand for.
        """
        # (x - mean) @ shapes.T without a copy of x that is as large as x.
        return (residuals @ self.shapes.T - self.mean @ self.shapes.T).astype(np.float32)

    def residuals(self, coefficients: np.ndarray) -> np.ndarray:
        """(N, K) coefficients to (N, 3 Vp) float32 residuals, both in mesh units."""
        return (coefficients @ self.shapes + self.mean).astype(np.float32)

    def first(self, count: int) -> "Basis":
        """The basis of the first `count` shapes alone."""
        return Basis(self.mean, self.shapes[:count], float(self.left[count]), self.left[: count + 1])


def share_shapes(left: Sequence[np.ndarray], vertices: Sequence[int], tolerance: float, units: int) -> list[int]:
    """How many shapes each partition needs, for the rms distance of all of them together to come to the tolerance.

    A shape more goes where it takes off the most for the numbers that it adds to a frame: partitions whose residuals
    are simple get more than their own tolerance asks for, those that go on and on get fewer. A partition may leave a
    hundredth of its own residual in place of the tolerance, where that is more, as in `make_basis`.

    Args:
        left: for each partition what is left by number of shapes, as `Basis.left`.
        vertices: of each.
        tolerance: rms distance over poses and all vertices that may remain, mesh units.
        units: how many numbers a shape adds to a network, beside three for each vertex.

    Returns:
        The numbers of shapes.
    """
    allowed = [max(tolerance, NEGLIGIBLE * float(own[0])) for own in left]
    counts, gains = [], []
    for number, (own, size, most) in enumerate(zip(left, vertices, allowed, strict=True)):
        enough = own <= WORST * most
        counts.append(int(np.argmax(enough)) if enough.any() else len(own) - 1)
        taken = size * (own[:-1] ** 2 - own[1:] ** 2)[counts[-1] :]
        gains += [(taken_off / (3 * size + units), number, taken_off) for taken_off in taken.tolist()]
    remaining = sum(size * float(own[k]) ** 2 for own, size, k in zip(left, vertices, counts, strict=True))
    wanted = sum(size * most**2 for size, most in zip(vertices, allowed, strict=True))
    # Those of one partition come in their order: each takes off no more than the one before it.
    for _, number, taken_off in sorted(gains, key=lambda gain: -gain[0]):
        if remaining <= wanted:
            break
        counts[number] += 1
        remaining -= taken_off
    return counts


def make_basis(
    residuals: np.ndarray, tolerance: float, rng: np.random.Generator, weights: np.ndarray | None = None
) -> Basis:
    """Find the basis shapes that bring the rms distance to the tolerance.

    Principal components through the Gram matrix of the poses, or through the covariance of the coordinates where
    those are fewer; a singular value decomposition of the residuals costs more than the training.

    Args:
        residuals: (N, 3 Vp) float32, the training poses of one partition, mesh units.
        tolerance: rms distance over poses and vertices that may remain, mesh units.
        rng: chooses the poses when there are more than `MAX_POSES`.
        weights: (N,) how much each pose counts; all the same when left out.
    """
    weights = np.ones(len(residuals)) if weights is None else weights
    mean = _weighted_mean(residuals, weights)
    count, width = residuals.shape
    if count > MAX_POSES and width > MAX_POSES:
        rows = np.sort(rng.choice(count, MAX_POSES, replace=False))
        residuals, weights, count = residuals[rows], weights[rows], MAX_POSES
    by_pose = count <= width
    roots = np.sqrt(weights)[:, None]
    products = np.zeros((min(count, width),) * 2)
    for block in _blocks(width if by_pose else count):
        part = residuals[:, block] if by_pose else residuals[block]
        centered = (part.astype(np.float64) - (mean[block] if by_pose else mean)) * roots[
            slice(None) if by_pose else block
        ]
        products += centered @ centered.T if by_pose else centered.T @ centered
    values, vectors = np.linalg.eigh(products)
    values, vectors = np.maximum(values[::-1], 0), vectors[:, ::-1]
    # What is left after the first k components, as an rms over poses and vertices.
    left = np.sqrt(np.append(np.cumsum(values[::-1])[::-1], 0) / (weights.sum() * width / 3))
    shapes_needed = min(int(np.argmax(left <= max(tolerance, NEGLIGIBLE * left[0]))), MAX_SHAPES)
    vectors = vectors[:, :shapes_needed]
    if by_pose:
        shapes = np.empty((width, shapes_needed))
        for block in _blocks(width):
            # Block by block: a product with float64 would make a float64 copy of all residuals.
            shapes[block] = ((residuals[:, block].astype(np.float64) - mean[block]) * roots).T @ vectors
        vectors = np.linalg.qr(shapes)[0] if shapes_needed else shapes
    shapes = np.ascontiguousarray(vectors.T, np.float32)
    return Basis(mean, shapes, float(left[shapes_needed]), left[: shapes_needed + 1])


def _weighted_mean(residuals: np.ndarray, weights: np.ndarray) -> np.ndarray:
    if (weights == 1).all():
        return residuals.mean(axis=0, dtype=np.float64).astype(np.float32)
    total = np.zeros(residuals.shape[1])
    for block in _blocks(residuals.shape[1]):
        total[block] = weights @ residuals[:, block].astype(np.float64)
    return (total / weights.sum()).astype(np.float32)


def _blocks(length: int) -> list[slice]:
    return [slice(start, start + COLUMN_BLOCK) for start in range(0, length, COLUMN_BLOCK)]
