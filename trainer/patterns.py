# SPDX-License-Identifier: GPL-3.0-or-later
"""Patterns of a large partition: what it plays beside linear skinning, in fewer numbers for each vertex.

A joint takes four numbers for each vertex, a shape three, and many of them say nearly the same: the elbow's shapes lie
where the elbow's fit does. So the matrix of all joints and shapes is taken apart into a small one and few patterns, a
number for each vertex: its singular value decomposition, as the training poses weigh it.
"""

from dataclasses import dataclass, replace

import numpy as np

from .basis import Basis
from .joint_fit import JointFit, Surroundings

TOLERANCE_PART = 0.1
"""What patterns may leave of a partition, as a part of what its shapes may."""
PRODUCT_FLOATS = 6_000
"""A product more takes as much of a frame as reading so many constants."""


@dataclass(frozen=True)
class Patterns:
    """What a partition plays, all of it made of patterns.

    Attributes:
        numbers: (r, Vp) float32 patterns, orthonormal rows, no unit.
        fit, basis: as they were, but for what no pattern reaches.
        coefficients: (N, K) float32 of this basis, mesh units.
        left: rms distance over training poses and vertices to what was played before, mesh units.
    """

    numbers: np.ndarray
    fit: JointFit
    basis: Basis
    coefficients: np.ndarray
    left: float


def may_have_patterns(fit: JointFit, basis: Basis) -> bool:
    """Whether a partition plays so many numbers that patterns may be fewer."""
    return len(fit.joints) > 0 and _height(fit, basis) * fit.factors.shape[1] >= 2 * PRODUCT_FLOATS


def find_patterns(
    fit: JointFit,
    basis: Basis,
    coefficients: np.ndarray,
    surroundings: Surroundings,
    training: np.ndarray,
    weights: np.ndarray,
    tolerance: float,
) -> Patterns | None:
    """Find the patterns of a partition; None where they save fewer numbers than a product takes.

    Args:
        fit, basis: of the partition.
        coefficients: (N, K) of all poses, mesh units.
        surroundings: of the partition, as it was fitted.
        training: indices of the training poses.
        weights: what each of these counts.
        tolerance: rms distance over poses and vertices that the shapes may leave, mesh units.
    """
    height, vertices = _height(fit, basis), fit.factors.shape[1]
    rows = _rows(surroundings.rows_of(fit.joints)[training], coefficients[training], weights)
    values, vectors = np.linalg.eigh(rows.T @ rows)
    weighed = (np.sqrt(np.maximum(values, 0)) * vectors).T @ _numbers(fit, basis, surroundings.center)
    squares, vectors = np.linalg.eigh(weighed @ weighed.T)
    squares, vectors = np.maximum(squares[::-1], 0), vectors[:, ::-1]
    left = np.sqrt(np.append(np.cumsum(squares[::-1])[::-1], 0) / (weights.sum() * vertices))
    rank = int(np.argmax(left <= TOLERANCE_PART * tolerance))
    if rank * (height + vertices) + PRODUCT_FLOATS > height * vertices:
        return None
    patterns = np.linalg.qr(weighed.T @ vectors[:, :rank])[0].T.astype(np.float32)
    factors = (fit.factors @ patterns.T.astype(np.float64)) @ patterns
    fit = replace(fit, factors=factors.astype(np.float32))
    basis, coefficients = _made_of(patterns, basis, coefficients, float(left[rank]))
    return Patterns(patterns, fit, basis, coefficients, float(left[rank]))


def _height(fit: JointFit, basis: Basis) -> int:
    return len(fit.factors) + 3 * len(basis.shapes)


def _rows(moved: np.ndarray, coefficients: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(3 N, 4 Jf + 3 K) float64, what the numbers of a vertex are multiplied by, as the main joint sees it."""
    shaped = np.einsum("nk,ab->nakb", coefficients.astype(np.float64), np.eye(3))
    rows = np.concatenate([moved, shaped.reshape(len(moved), 3, 3 * coefficients.shape[1])], axis=2)
    return (rows * np.sqrt(weights)[:, None, None]).reshape(3 * len(rows), -1)


def _numbers(fit: JointFit, basis: Basis, center: np.ndarray) -> np.ndarray:
    """(4 Jf + 3 K, Vp) float64, the numbers of the vertices; the mean belongs to the main joint, which sees it rest."""
    vertices, shapes = fit.factors.shape[1], len(basis.shapes)
    factors = fit.factors.reshape(-1, 4, vertices).astype(np.float64)
    factors[:, :3] -= center[:, None] * factors[:, 3:]
    factors[0, :3] += basis.mean.reshape(vertices, 3).T
    return np.concatenate(
        [factors.reshape(-1, vertices), _by_axis(basis.shapes, vertices).reshape(3 * shapes, vertices)]
    )


def _made_of(patterns: np.ndarray, basis: Basis, coefficients: np.ndarray, left: float) -> tuple[Basis, np.ndarray]:
    """A basis as nearly as patterns have it, its shapes orthonormal again, and the coefficients of what it was."""
    vertices, patterns = patterns.shape[1], patterns.astype(np.float64)
    mean = _by_axis(basis.mean[None], vertices)[0] @ patterns.T @ patterns
    shapes = _by_axis(basis.shapes, vertices) @ patterns.T
    turned, mixed = np.linalg.qr(shapes.reshape(len(shapes), 3 * len(patterns)).T)
    count = turned.shape[1]
    shapes = (turned.T.reshape(count, 3, len(patterns)) @ patterns).transpose(0, 2, 1).reshape(count, 3 * vertices)
    made = Basis(
        mean.T.reshape(-1).astype(np.float32),
        np.ascontiguousarray(shapes, np.float32),
        float(np.hypot(basis.truncation, left)),
        np.hypot(basis.left[: count + 1], left),
    )
    return made, (coefficients @ mixed.T).astype(np.float32)


def _by_axis(shapes: np.ndarray, vertices: int) -> np.ndarray:
    """(K, 3 Vp) to (K, 3, Vp) float64."""
    return shapes.reshape(len(shapes), vertices, 3).transpose(0, 2, 1).astype(np.float64)
