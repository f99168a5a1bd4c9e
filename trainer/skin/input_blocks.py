# SPDX-License-Identifier: GPL-3.0-or-later
"""Features of joints and controls in poses, in blocks of principal components, and fits to them."""

import numpy as np

from ..fits.least_squares import solve_ridge
from .fit_poses import FitPoses

BLOCK_COLUMNS = 6
"""Largest number of principal components of the features of an input."""
MIN_SPREAD = 1e-4
"""Principal components with a smaller standard deviation count as constant."""
LENGTH_RATIO = 0.05
"""Length that counts as much as a rotation by one radian, as a part of the character's size."""
MAX_PRODUCT_FACTORS = 7
"""Largest number of columns whose products are added to a fit."""
RIDGE = 1e-3
"""Ridge of a fit, for columns with a variance of 1."""


class InputBlocks:
    """Features of J joints and C controls in n poses.

    The training poses are those with even indices. The columns of a block are uncorrelated there, with mean 0 and
    variance 1. Features of a joint are relative to its nearest ancestor that was not removed, as those of a model.

    Attributes:
        count: J + C; the block of control c is J + c.
        widths: (J + C,) number of columns of each block; 0 if the input does not change.
        parents: (J,) nearest ancestor of each joint that was not removed; -1 if there is none. In this module and in
            `key_joints`, the parent of a joint is its reference joint.
    """

    def __init__(self, poses: FitPoses):
        """Compute the features of poses."""
        self._size, self.parents = max(poses.rig.size, 1e-9), poses.rig.references
        self._poses, self._rest = (
            matrices.astype(np.float64) for matrices in (poses.pose_matrices, poses.rig.rest_matrices)
        )
        self._inverse_poses, self._inverse_rest = np.linalg.inv(self._poses), np.linalg.inv(self._rest)
        joint_count = len(self.parents)
        self.count = joint_count + poses.controls.shape[1]
        self._columns = np.zeros((self.count, BLOCK_COLUMNS, len(self._poses)))
        self.widths = np.zeros(self.count, int)
        for joint in range(joint_count):
            self._set(joint, self._joint_features(joint))
        for block, values in enumerate(poses.controls.T.astype(np.float64), joint_count):
            self._set(block, _standardize(values[:, None]))
        self._is_usable = self.widths > 0

    def _set(self, block: int, features: np.ndarray) -> None:
        # Principal components, with variance 1 in the training poses.
        centered = features - features[::2].mean(axis=0)
        covariance = centered[::2].T @ centered[::2] / len(centered[::2])
        variances, axes = np.linalg.eigh(covariance)
        order = np.argsort(-variances)[:BLOCK_COLUMNS]
        order = order[variances[order] > MIN_SPREAD**2]
        components = centered @ axes[:, order] / np.sqrt(variances[order])
        self.widths[block] = components.shape[1]
        self._columns[block] = 0
        self._columns[block, : components.shape[1]] = components.T

    def _joint_features(self, joint: int) -> np.ndarray:
        """Return (n, 15): transform relative to the parent and the rest pose, lengths as ratios, and half the rotation.

        A joint that follows half of a rotation is a linear function of half-rotation features (docs/method.md).
        """
        parent, matrices, rest = self.parents[joint], self._poses[:, joint], self._rest[joint]
        if parent >= 0:
            matrices, rest = self._inverse_poses[:, parent] @ matrices, self._inverse_rest[parent] @ rest
        relative = (np.linalg.inv(rest) @ matrices)[:, :3]
        relative[..., 3] /= LENGTH_RATIO * self._size
        rotations = relative[..., :3]
        skew = rotations - np.swapaxes(rotations, -1, -2)
        halves = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
        halves /= np.maximum(3 + np.trace(rotations, axis1=1, axis2=2), 0.1)[:, None]
        return np.concatenate([relative.reshape(-1, 12), 2 * halves], axis=1)

    def children(self, joint: int) -> list[int]:
        """Return the joints, removed ones among them, whose features are relative to a joint."""
        return np.flatnonzero(self.parents == joint).tolist()

    def remove(self, joint: int) -> list[int]:
        """Remove a joint, and return its children, whose features are relative to its parent now."""
        self._is_usable[joint] = False
        children = self.children(joint)
        for child in children:
            self.parents[child] = self.parents[joint]
            self._set(child, self._joint_features(child))
        return children

    def restore(self, joint: int, children: list[int]) -> None:
        """Undo `remove`."""
        self._is_usable[joint] = self.widths[joint] > 0
        for child in children:
            self.parents[child] = joint
            self._set(child, self._joint_features(child))

    def best_block(self, remaining: np.ndarray, excluded: tuple[int, ...]) -> int | None:
        """Return the block that explains most of the remaining motion in training poses.

        Args:
            remaining: (n / 2, 12) motion that the used blocks do not explain.
            excluded: blocks to leave out, those that are used already among them.
        """
        is_usable = self._is_usable & (self.widths > 0)
        is_usable[list(excluded)] = False
        if not is_usable.any():
            return None
        gains = ((self._columns[:, :, ::2] @ remaining) ** 2).sum(axis=(1, 2)) / len(remaining)
        # Columns explain a part of any motion by chance, each one n-th.
        gains -= self.widths * (remaining**2).sum() / len(remaining)
        return int(np.where(is_usable, gains, -np.inf).argmax())

    def select(self, blocks: tuple[int, ...]) -> np.ndarray:
        """Return the (n, c) columns of blocks, with the products of the first of each block."""
        columns = np.concatenate([self._columns[block, : self.widths[block]] for block in blocks]).T
        share = max(1, MAX_PRODUCT_FACTORS // len(blocks))
        factors = np.concatenate([self._columns[block, : min(share, self.widths[block])] for block in blocks]).T
        first, second = np.triu_indices(factors.shape[1])
        return np.concatenate([columns, _standardize(factors[:, first] * factors[:, second])], axis=1)


def predict(columns: np.ndarray, motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit the (n / 2, m) motion in training poses by (n, c) columns; return the fit there and in the other poses."""
    training, held_out = columns[::2], columns[1::2]
    coefficients = solve_ridge(training.T @ training, training.T @ motion, RIDGE * len(training))
    return training @ coefficients, held_out @ coefficients


def _standardize(columns: np.ndarray) -> np.ndarray:
    """Return (n, c) columns with mean 0 and variance 1 in the training poses; constant columns become 0."""
    training = columns[::2]
    spread = training.std(axis=0)
    return np.where(spread > 1e-9, (columns - training.mean(axis=0)) / np.maximum(spread, 1e-9), 0)
