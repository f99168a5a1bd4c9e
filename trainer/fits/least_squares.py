# SPDX-License-Identifier: GPL-3.0-or-later
"""The solver of all linear least-squares problems of the trainer, with the regularization that they use."""

import numpy as np


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
