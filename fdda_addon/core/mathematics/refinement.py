# SPDX-License-Identifier: GPL-3.0-or-later
"""Choice of poses to add to a recording: near large errors of a model, and where recorded poses are sparse."""

from dataclasses import dataclass

import numpy as np

from .poses import Channel

SPARSE_CHOICE_RATIO = 1 / 3
"""Ratio of the probes that are chosen by their distance from recorded poses; the others are chosen by their error."""
JITTER_RATIO = 0.15
"""Standard deviation of the noise that is added to a chosen probe, as a ratio of half the range of motion."""
WORST_PROBE_RATIO = 0.1
"""The weight of a partition is its mean error over the probes with the largest errors, this ratio of all probes."""


@dataclass(frozen=True)
class Probes:
    """M poses in which a model was compared with its rig.

    Attributes:
        values: (M, C) float64, values of the channels, radians or meters.
        errors: (M, P) largest error of each partition, meters.
        distances: (M, P) distance to the nearest recorded pose, computed from the joints that influence each partition,
            no unit.
    """

    values: np.ndarray
    errors: np.ndarray
    distances: np.ndarray


def nearest_recorded_distances(points: np.ndarray, recorded: np.ndarray) -> np.ndarray:
    """Compute the distance of each point to the nearest recorded point.

    Features are divided by their standard deviations, so distances have no unit.

    Args:
        points: (M, F) features.
        recorded: (N, F) features of the recorded poses.

    Returns:
        (M,) float64, 0 where no feature varies.
    """
    deviations = recorded.std(axis=0, dtype=np.float64)
    is_varying = deviations > deviations.max(initial=0) * 1e-3
    if not is_varying.any():
        return np.zeros(len(points))
    scaled_points, scaled_recorded = (array[:, is_varying] / deviations[is_varying] for array in (points, recorded))
    squared_distances = (
        (scaled_points**2).sum(axis=1)[:, None]
        - 2 * scaled_points @ scaled_recorded.T
        + (scaled_recorded**2).sum(axis=1)
    )
    return np.sqrt(np.maximum(squared_distances.min(axis=1), 0))


def choose_poses(
    probes: Probes,
    channels: tuple[Channel, ...],
    channels_by_partition: list[np.ndarray],
    base_poses: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """Choose poses that improve a model.

    Each pose combines probes for several partitions, in a random order that prefers large errors. A partition copies
    the values of its channels from a probe, unless another one has already set one of these channels. A channel that no
    partition sets keeps its value in `base_poses`.

    Args:
        probes: compared poses and their errors.
        channels: C channels with their ranges.
        channels_by_partition: for each of P partitions, indices of the channels that influence it.
        base_poses: (n, C) random poses to start from.
        rng: random generator.

    Returns:
        (n, C) float64, inside the ranges.
    """
    low, high = np.array([(channel.low, channel.high) for channel in channels]).T
    worst_errors = np.sort(probes.errors, axis=0)[-max(1, round(len(probes.errors) * WORST_PROBE_RATIO)) :]
    weights = worst_errors.mean(axis=0)
    squares = (np.square(scores, dtype=np.float64) + 1e-30 for scores in (probes.errors, probes.distances))
    by_error, by_distance = (squared / squared.sum(axis=0) for squared in squares)
    poses = base_poses.copy()
    for pose in poses:
        is_free = np.ones(len(channels), bool)
        # Weighted random order without replacement (Efraimidis and Spirakis, 2006).
        for partition in np.argsort(rng.exponential(size=len(weights)) / np.maximum(weights, 1e-12)):
            channel_indices = channels_by_partition[partition]
            if not len(channel_indices) or not is_free[channel_indices].all():
                continue
            probabilities = by_distance if rng.random() < SPARSE_CHOICE_RATIO else by_error
            probe = rng.choice(len(probes.values), p=probabilities[:, partition])
            noise = rng.standard_normal(len(channel_indices)) * JITTER_RATIO * (high - low)[channel_indices] / 2
            pose[channel_indices] = probes.values[probe, channel_indices] + noise
            is_free[channel_indices] = False
    return np.clip(poses, low, high)
