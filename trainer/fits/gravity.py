# SPDX-License-Identifier: GPL-3.0-or-later
"""Tests whether a surface that is simulated, or read from a file, depends on the direction of gravity.

The influences of such a surface cannot be found by moving its joints. With all ancestor joints as inputs, a network
learns the effect of gravity. Where gravity has no effect, the extra inputs make the model worse, because they correlate
by chance within one action. docs/simulations.md has both cases. The decision uses the recorded poses: kernel ridge
regression with cross-validation compares the inputs, because training two networks would take twice as long.
"""

from dataclasses import replace

import numpy as np

from fdda_addon.core.features import MIN_FEATURE_SPREAD, joint_features_in_metres
from fdda_addon.core.partition import Partition, assume_nearby_influences
from fdda_addon.core.recording.reader import Recording
from fdda_addon.core.recording.target import POSE

from ..data.split import Split
from .least_squares import solve_ridge

MAX_POSES, MAX_COMPONENTS = 300, 16
"""Maximum numbers of poses, and of principal components of each partition's residuals."""
FOLD_COUNT, CHUNK_COUNT = 5, 25
"""Numbers of cross-validation folds and of chunks. Folds consist of chunks of consecutive poses, because adjacent
frames are similar."""
KERNEL_WIDTHS, RIDGES = (1.0, 3.0), (1e-4, 1e-2)
"""Kernel widths in standard deviations of the features, and ridges. The combination with the lowest error is used."""


def drop_gravity_input(recording: Recording, split: Split) -> Recording:
    """Remove the joints that carry the direction of gravity from the influences, unless they improve the prediction.

    If the target depends on the pose alone, its influences were found by moving joints, and do not change.

    Args:
        recording: the recording; only its partitions change.
        split: split of its poses; held-out poses are not used.
    """
    target = recording.info.target
    if target is None or target.follows == POSE:
        return recording
    without_gravity = assume_nearby_influences(recording.rig, recording.partitions, may_sag=False)
    poses = np.sort(np.concatenate([split.training, split.validation]))
    poses = poses[np.unique(np.linspace(0, len(poses) - 1, MAX_POSES).astype(np.int64))]
    features = joint_features_in_metres(recording.pose_matrices[poses], recording.rig).astype(np.float64)
    joints = [_squared_distances(features[:, joint]) for joint in range(features.shape[1])]
    controls = [_squared_distances(values[:, None]) for values in recording.controls[poses].T.astype(np.float64)]
    errors = np.zeros(2)
    for alternatives in zip(recording.partitions, without_gravity, strict=True):
        scores = _principal_scores(recording.residuals[np.ix_(poses, alternatives[0].vertices)])
        errors += [_best_error(_mean_distances(joints, controls, partition), scores) for partition in alternatives]
    return replace(recording, partitions=without_gravity) if errors[1] < errors[0] else recording


def _squared_distances(features: np.ndarray) -> np.ndarray | None:
    """Return (n, n) float32 squared distances of poses in the features of a joint or control.

    Args:
        features: (n, f); each is divided by its standard deviation.

    Returns:
        The distances; None where no feature varies.
    """
    spread = features.std(axis=0)
    varies = spread > MIN_FEATURE_SPREAD * max(1.0, np.abs(features).max())
    if not varies.any():
        return None
    scaled = (features[:, varies] - features[:, varies].mean(axis=0)) / (spread[varies] * np.sqrt(varies.sum()))
    squares = (scaled**2).sum(axis=1)
    return np.maximum(squares[:, None] + squares - 2 * scaled @ scaled.T, 0).astype(np.float32)


def _mean_distances(
    joints: list[np.ndarray | None], controls: list[np.ndarray | None], partition: Partition
) -> np.ndarray:
    """Return the (n, n) mean distances over the joints and controls that influence a partition; 0 where none varies."""
    influencing = [joints[joint] for joint in partition.influencing] + [controls[c] for c in partition.controls]
    varying = [distances for distances in influencing if distances is not None]
    return np.mean(varying, axis=0, dtype=np.float64) if varying else np.zeros(())


def _principal_scores(residuals: np.ndarray) -> np.ndarray:
    """Return (n, k) float64 coefficients of the first principal components of (n, V, 3) residuals."""
    flat = residuals.reshape(len(residuals), -1).astype(np.float64)
    left_vectors, singular_values, _ = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)
    return (left_vectors * singular_values)[:, :MAX_COMPONENTS]


def _best_error(distances: np.ndarray, values: np.ndarray) -> float:
    """Return the lowest sum of squared cross-validation errors of (n, k) values over all widths and ridges."""
    count = len(values)
    distances = np.broadcast_to(distances, (count, count))
    fold = np.arange(count) * CHUNK_COUNT // count % FOLD_COUNT
    errors = []
    for width in KERNEL_WIDTHS:
        kernel = np.exp(-distances / (2 * width**2))
        for ridge in RIDGES:
            error = 0.0
            for is_tested in (fold == index for index in range(FOLD_COUNT)):
                factors = solve_ridge(kernel[np.ix_(~is_tested, ~is_tested)], values[~is_tested], ridge)
                predicted = kernel[np.ix_(is_tested, ~is_tested)] @ factors
                error += float(((values[is_tested] - predicted) ** 2).sum())
            errors.append(error)
    return min(errors)
