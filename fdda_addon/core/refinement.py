# SPDX-License-Identifier: GPL-3.0-or-later
"""Choice of poses to add to a recording: near large errors of a model, and where recorded poses are sparse."""

from dataclasses import dataclass

import numpy as np

from .poses import Channel

SPARSE_CHOICE_RATIO = 1 / 3
"""Ratio of the choices by sparsity of recorded poses; the others are chosen by error."""
JITTER_RATIO = 0.15
"""Standard deviation around a chosen probe, as a ratio of half the range of motion."""
WORST_PROBE_RATIO = 0.1
"""The weight of a partition is its mean error over this ratio of the worst probes."""


@dataclass(frozen=True)
class Probes:
    """M poses in which a model was compared with its rig.

    Attributes:
        values: (M, C) float64, of the channels, radians or meters.
        errors: (M, P) largest error of each partition, meters.
        distances: (M, P) distance to the nearest recorded pose, of the joints that influence each partition, no unit.
    """

    values: np.ndarray
    errors: np.ndarray
    distances: np.ndarray


def nearest_recorded_distances(points: np.ndarray, recorded: np.ndarray) -> np.ndarray:
    """Compute the distance of each point to the nearest recorded one, in units of each feature's standard deviation.

    Args:
        points: (M, F). recorded: (N, F).

    Returns:
        (M,) float64, 0 where no feature varies.
    """
    spread = recorded.std(axis=0, dtype=np.float64)
    used = spread > spread.max(initial=0) * 1e-3
    if not used.any():
        return np.zeros(len(points))
    first, second = (array[:, used] / spread[used] for array in (points, recorded))
    squared = (first**2).sum(axis=1)[:, None] - 2 * first @ second.T + (second**2).sum(axis=1)
    return np.sqrt(np.maximum(squared.min(axis=1), 0))


def choose_poses(
    probes: Probes,
    channels: tuple[Channel, ...],
    channels_by_partition: list[np.ndarray],
    base: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """Choose poses that improve a model.

    Each pose combines probes for several partitions. In a random order that prefers large errors, each partition sets
    its channels to those of one of its probes, unless another partition has set one of them; a channel that no
    partition sets stays as in `base`.

    Args:
        probes: where the model errs.
        channels: C channels with their ranges.
        channels_by_partition: for each of P partitions, indices of the channels that influence it.
        base: (n, C) random poses to start from.
        rng: random generator.

    Returns:
        (n, C) float64, inside the ranges.
    """
    low, high = np.array([(channel.low, channel.high) for channel in channels]).T
    worst = np.sort(probes.errors, axis=0)[-max(1, round(len(probes.errors) * WORST_PROBE_RATIO)) :]
    weights = worst.mean(axis=0)
    by_error, by_distance = (_to_probabilities(scores) for scores in (probes.errors, probes.distances))
    poses = base.copy()
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


def _to_probabilities(scores: np.ndarray) -> np.ndarray:
    """Convert (M, P) scores to probabilities over the M probes, proportional to their squares."""
    squared = np.square(scores, dtype=np.float64) + 1e-30
    return squared / squared.sum(axis=0)
