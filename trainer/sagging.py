# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether a surface that was simulated, or comes from a file, depends on which way is down.

Nobody can move a joint of it to see. With all joints above as inputs, what sags is learned, and what does not is
learned worse, as there is more that frames of one action have in common by chance: docs/simulations.md has both. So
it is asked of the poses, by kernel ridge regression: a network for each answer would take as long as the training.
"""

from dataclasses import replace

import numpy as np

from fdda_addon.core.features import joint_features_in_metres
from fdda_addon.core.partition import Partition, assume_nearby_influences
from fdda_addon.core.recording.reader import Recording
from fdda_addon.core.recording.target import POSE

from .data import MIN_SPREAD, Split

MOST_POSES, SHAPES = 300, 16
"""So much is looked at: poses, and principal components of the residuals of each partition."""
FOLDS, PIECES = 5, 25
"""Each of the folds is predicted from the others; poses in pieces, as frames resemble those beside them."""
WIDTHS, RIDGES = (1.0, 3.0), (1e-4, 1e-2)
"""Of the kernels, in standard deviations of the features, and of the regression: the best of them counts."""


def without_needless_down(recording: Recording, split: Split) -> Recording:
    """A recording without the joints that say which way is down, unless they help to predict poses from others.

    Where the target follows the pose at once, influences were found by moving joints, and stay.

    Args:
        recording: any; only its partitions change.
        split: its poses; those that are held out are not looked at.
    """
    target = recording.info.target
    if target is None or target.follows == POSE:
        return recording
    plain = assume_nearby_influences(recording.rig, recording.partitions, sags=False)
    poses = np.sort(np.concatenate([split.training, split.validation]))
    poses = poses[np.unique(np.linspace(0, len(poses) - 1, MOST_POSES).astype(np.int64))]
    features = joint_features_in_metres(recording.pose_matrices[poses], recording.rig).astype(np.float64)
    joints = [_squared_distances(features[:, joint]) for joint in range(features.shape[1])]
    controls = [_squared_distances(values[:, None]) for values in recording.controls[poses].T.astype(np.float64)]
    errors = np.zeros(2)
    for both in zip(recording.partitions, plain, strict=True):
        values = _principal(recording.residuals[np.ix_(poses, both[0].vertices)])
        errors += [_error(_mean_distances(joints, controls, partition), values) for partition in both]
    return replace(recording, partitions=plain) if errors[1] < errors[0] else recording


def _squared_distances(features: np.ndarray) -> np.ndarray | None:
    """(n, n) float32 between poses, of the features (n, f) of a joint or control, each in its standard deviations; None
    where none of them varies."""
    spread = features.std(axis=0)
    moves = spread > MIN_SPREAD * max(1.0, np.abs(features).max())
    if not moves.any():
        return None
    scaled = (features[:, moves] - features[:, moves].mean(axis=0)) / (spread[moves] * np.sqrt(moves.sum()))
    squares = (scaled**2).sum(axis=1)
    return np.maximum(squares[:, None] + squares - 2 * scaled @ scaled.T, 0).astype(np.float32)


def _mean_distances(
    joints: list[np.ndarray | None], controls: list[np.ndarray | None], partition: Partition
) -> np.ndarray:
    """(n, n) mean of those of the joints and controls that influence a partition; a 0 where none of them moves."""
    influencing = [joints[joint] for joint in partition.influencing] + [controls[c] for c in partition.controls]
    found = [distances for distances in influencing if distances is not None]
    return np.mean(found, axis=0, dtype=np.float64) if found else np.zeros(())


def _principal(residuals: np.ndarray) -> np.ndarray:
    """(n, k) float64 coefficients of the largest principal components of residuals (n, V, 3)."""
    flat = residuals.reshape(len(residuals), -1).astype(np.float64)
    left, sizes, _ = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)
    return (left * sizes)[:, :SHAPES]


def _error(distances: np.ndarray, values: np.ndarray) -> float:
    """Sum of squared errors with which values (n, k) are predicted from those of the other folds."""
    count = len(values)
    distances = np.broadcast_to(distances, (count, count))
    fold = np.arange(count) * PIECES // count % FOLDS
    tried = []
    for width in WIDTHS:
        kernel = np.exp(-distances / (2 * width**2))
        for ridge in RIDGES:
            error = 0.0
            for left_out in (fold == number for number in range(FOLDS)):
                known = kernel[np.ix_(~left_out, ~left_out)] + ridge * np.eye(int((~left_out).sum()))
                factors = np.linalg.solve(known, values[~left_out])
                error += float(((values[left_out] - kernel[np.ix_(left_out, ~left_out)] @ factors) ** 2).sum())
            tried.append(error)
    return min(tried)
