# SPDX-License-Identifier: GPL-3.0-or-later
"""Confidence: how far a pose lies inside what the training has seen.

The range of a joint is a box around its features in the training poses, with a margin; that of a control, around its
values. The excess of a pose is its distance from the box in units of a fade width that grows with the range. With e the
excess over all joints and controls that count for a partition, its confidence is max(0, 1 - e^2)^2: exactly 1 inside,
0 from one fade width on, smooth at both ends.
"""

from dataclasses import dataclass, replace

import numpy as np

from fdda_addon.core.controls import Control
from fdda_addon.core.features import FEATURES_PER_JOINT
from fdda_addon.core.partition import Partition
from fdda_addon.core.rig import Rig
from fdda_addon.core.skinning import SkinBlock

MARGIN = 0.1
"""Margin of the box on each side, as a part of the range."""
FADE = 6.0
"""Fade width, as a part of the range. Wide: the residual at the border of the range stands in well for those outside.

Measured on the arm, before there was a linear fit: at 3 times the range of motion the mean error is 51 % of linear
skinning's, with a fade width of 0.15 it was 92 %."""
MIN_MARGIN = (0.01, 0.001)
MIN_FADE = (4.0, 0.2)
"""Least margin and fade width: of rotation elements, no unit, and of translations, as a part of the character's size.

A locked axis has no range of its own; these are what it may turn before it counts, and where the confidence is 0. Those
of a control are the first of each, as a part of the range that it was recorded for."""
LOCKED = 1e-4
"""A joint whose features spread less than this was locked in the recording (no unit, or mesh units)."""


@dataclass(frozen=True)
class TrainingRange:
    """What the training has seen of each joint and control.

    Attributes:
        low, high: (F,) float32, the box with its margin, around all features that networks see (`Inputs`).
        width: (12 J + C,) float32, fade width of the features of joints and controls; only these count.
        counts: (P, 12 J + C) bool, the features that count for a partition: those of what influences it, and of what
            was locked beside it, of which nobody knows whether it would.
        controls: C controls with the ranges that they had.
    """

    low: np.ndarray
    high: np.ndarray
    width: np.ndarray
    counts: np.ndarray
    controls: tuple[Control, ...] = ()

    def confidence(self, features: np.ndarray) -> np.ndarray:
        """Compute the confidence of each partition, (N, P) float32, from (N, F) features."""
        size = len(self.width)
        own = features[:, :size]
        excess = ((own - np.clip(own, self.low[:size], self.high[:size])) / self.width).astype(np.float64)
        return (np.maximum(0, 1 - excess**2 @ self.counts.T) ** 2).astype(np.float32)


def measure_training_range(features: np.ndarray, rig: Rig, partitions: tuple[Partition, ...]) -> TrainingRange:
    """Measure the range of the training poses.

    Args:
        features: (n, F) float32 of the training poses: 12 J of the joints relative to their parents, C controls, and
            what follows from these, mesh units.
        rig, partitions: of the recording.
    """
    low, high = features.min(axis=0), features.max(axis=0)
    spread, joints = high - low, len(rig.joints) * FEATURES_PER_JOINT
    own = joints + len(rig.controls)
    translation = (np.arange(len(low)) % 4 == 3) | (np.arange(len(low)) >= own)
    least_margin, least_fade = (
        np.where(translation, least[1] * rig.size, least[0]) for least in (MIN_MARGIN, MIN_FADE)
    )
    for least, part in ((least_margin, MIN_MARGIN[0]), (least_fade, MIN_FADE[0])):
        least[joints:own] = [part * _unit(control) for control in rig.controls]
    margin = np.maximum(MARGIN * spread, least_margin)
    width = np.maximum(FADE * spread, least_fade)[:own]
    ranges = zip(rig.controls, low[joints:own].tolist(), high[joints:own].tolist(), strict=True)
    return TrainingRange(
        *(array.astype(np.float32) for array in (low - margin, high + margin, width)),
        np.concatenate([_joints_that_count(spread, rig, partitions), _controls_that_count(rig, partitions)], axis=1),
        tuple(replace(control, low=least, high=most) for control, least, most in ranges),
    )


def _joints_that_count(spread: np.ndarray, rig: Rig, partitions: tuple[Partition, ...]) -> np.ndarray:
    """(P, 12 J) bool."""
    counts = np.zeros((len(partitions), len(rig.joints)), bool)
    by_joint = spread[: len(rig.joints) * FEATURES_PER_JOINT].reshape(-1, FEATURES_PER_JOINT)
    least = np.where(np.arange(FEATURES_PER_JOINT) % 4 == 3, LOCKED / rig.metres_per_unit, LOCKED)
    locked = (by_joint < least).all(axis=1)
    for number, partition in enumerate(partitions):
        beside = {partition.joint, rig.joints[partition.joint].parent, *SkinBlock(rig, partition).joints.tolist()}
        beside |= {child for child, joint in enumerate(rig.joints) if joint.parent == partition.joint}
        counts[number, [joint for joint in beside if joint >= 0 and locked[joint]]] = True
        counts[number, list(partition.influencing)] = True
    return np.repeat(counts, FEATURES_PER_JOINT, axis=1)


def _controls_that_count(rig: Rig, partitions: tuple[Partition, ...]) -> np.ndarray:
    """(P, C) bool. A control without a range was never moved to see what it does: it counts for every partition."""
    counts = np.tile(np.array([control.low == control.high for control in rig.controls], bool), (len(partitions), 1))
    for number, partition in enumerate(partitions):
        counts[number, list(partition.controls)] = True
    return counts


def _unit(control: Control) -> float:
    """The range that a control was recorded for; where it has none its value, or 1, the range of most sliders."""
    return control.high - control.low or max(1.0, abs(control.low))
