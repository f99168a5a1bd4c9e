# SPDX-License-Identifier: GPL-3.0-or-later
"""The confidence of a partition: 1 for a pose inside the range of the training poses, 0 for a pose far outside.

The range of a joint is a box around its features in the training poses, with a margin. The range of a control is an
interval around its values. Shape keys do not count, because the linear fit is exact in any range. The excess of a pose
is its distance from the box, divided by a fade width that grows with the range. With e the excess over all joints and
controls that count for a partition, the confidence is max(0, 1 - e^2)^2. It is exactly 1 inside the box, 0 beyond one
fade width, and smooth between.
"""

from dataclasses import dataclass, replace

import numpy as np

from fdda_addon.core.controls import Control
from fdda_addon.core.mathematics.features import FEATURES_PER_JOINT
from fdda_addon.core.mathematics.partition import Partition
from fdda_addon.core.mathematics.skinning import SkinBlock
from fdda_addon.core.rig import STATIC_JOINT, Rig

MARGIN_RATIO = 0.1
"""Margin of the box on each side, as a part of the range."""
FADE_RATIO = 18.0
"""Fade width, as a part of the range. It is large, because the residual at the end of the range is a good approximation
outside the range. The linear fit has no bound without a fade: docs/experiments.md, Fade of the confidence."""
MIN_MARGINS = (0.01, 0.001)
MIN_FADE_WIDTHS = (12.0, 0.6)
"""Minimum margin and minimum fade width. The first value is for features without unit, and for controls, as a
part of their recorded range. The second is for lengths, as a part of the character's size. These minimums apply
to a locked axis, which has no range."""
MIN_LOCKED_SPREAD = 1e-4
"""A joint was locked in the recording if its features spread less than this: rotations no unit, translations meters."""


@dataclass(frozen=True)
class TrainingRange:
    """The range of the joints and controls in the training poses.

    Attributes:
        low, high: (F,) float32, bounds of all features (`NetworkInputs`), with the margin.
        fade_width: (12 J + C,) float32, fade width of the features of joints and controls. Other features have no
            effect on the confidence.
        counts: (P, 12 J + C) bool, the features on which the confidence of a partition depends. These are features of
            influencing joints and controls, and of adjacent joints that were locked, whose effect is unknown.
        controls: C controls with their recorded ranges.
    """

    low: np.ndarray
    high: np.ndarray
    fade_width: np.ndarray
    counts: np.ndarray
    controls: tuple[Control, ...] = ()

    def compute_confidence(self, features: np.ndarray) -> np.ndarray:
        """Compute the (N, P) float32 confidence of each partition from (N, F) features."""
        direct_count = len(self.fade_width)
        direct_features = features[:, :direct_count]
        clamped = np.clip(direct_features, self.low[:direct_count], self.high[:direct_count])
        excess = ((direct_features - clamped) / self.fade_width).astype(np.float64)
        return (np.maximum(0, 1 - excess**2 @ self.counts.T) ** 2).astype(np.float32)


def measure_training_range(
    features: np.ndarray, is_length: np.ndarray, rig: Rig, partitions: tuple[Partition, ...]
) -> TrainingRange:
    """Measure the range of the training poses.

    Args:
        features: (n, F) float32, features of the training poses from `NetworkInputs.compute_features`.
        is_length: (F,) bool, which features are lengths in mesh units.
    """
    low, high = features.min(axis=0), features.max(axis=0)
    spread, joint_columns = high - low, len(rig.joints) * FEATURES_PER_JOINT
    direct_columns = joint_columns + len(rig.controls)
    min_margin, min_fade_width = (
        np.where(is_length, minimum[1] * rig.size, minimum[0]) for minimum in (MIN_MARGINS, MIN_FADE_WIDTHS)
    )
    # Without a recorded range, the absolute value replaces it, or 1 if that is smaller: the range of most sliders.
    control_ranges = np.array([c.high - c.low or max(1.0, abs(c.low)) for c in rig.controls])
    for minimum, ratio in ((min_margin, MIN_MARGINS[0]), (min_fade_width, MIN_FADE_WIDTHS[0])):
        minimum[joint_columns:direct_columns] = ratio * control_ranges
    margin = np.maximum(MARGIN_RATIO * spread, min_margin)
    fade_width = np.maximum(FADE_RATIO * spread, min_fade_width)[:direct_columns]
    control_columns = slice(joint_columns, direct_columns)
    ranges = zip(rig.controls, low[control_columns].tolist(), high[control_columns].tolist(), strict=True)
    counts = [_counting_joints(spread, rig, partitions), _counting_controls(spread[control_columns], rig, partitions)]
    return TrainingRange(
        *(array.astype(np.float32) for array in (low - margin, high + margin, fade_width)),
        np.concatenate(counts, axis=1),
        tuple(replace(control, low=minimum, high=maximum) for control, minimum, maximum in ranges),
    )


def _counting_joints(spread: np.ndarray, rig: Rig, partitions: tuple[Partition, ...]) -> np.ndarray:
    """Return (P, 12 J) bool, the features of joints that count for each partition."""
    counts, references = np.zeros((len(partitions), len(rig.joints)), bool), rig.references
    by_joint = spread[: len(rig.joints) * FEATURES_PER_JOINT].reshape(-1, FEATURES_PER_JOINT)
    is_translation = np.arange(FEATURES_PER_JOINT) % 4 == 3
    min_spread = np.where(is_translation, MIN_LOCKED_SPREAD / rig.metres_per_unit, MIN_LOCKED_SPREAD)
    is_locked = (by_joint < min_spread).all(axis=1)
    if STATIC_JOINT not in rig.joint_names:
        # A joint without a reference joint carries the whole mesh.
        is_locked &= references >= 0
    for index, partition in enumerate(partitions):
        adjacent = {
            partition.joint,
            references[partition.joint],
            *SkinBlock(rig, partition.joint, partition.vertices).joints.tolist(),
        }
        adjacent |= set(np.flatnonzero(references == partition.joint).tolist())
        counts[index, [joint for joint in adjacent if joint >= 0 and is_locked[joint]]] = True
        counts[index, list(partition.influencing)] = True
    return np.repeat(counts, FEATURES_PER_JOINT, axis=1)


def _counting_controls(spread: np.ndarray, rig: Rig, partitions: tuple[Partition, ...]) -> np.ndarray:
    """Return (P, C) bool, the controls that count for each partition.

    A control without a range counts for every partition, because its effect was not recorded. A shape key that moved in
    the training poses counts for none, because its effect is linear; `spread` has the (C,) ranges in these poses.
    """
    counts = np.tile(np.array([control.low == control.high for control in rig.controls], bool), (len(partitions), 1))
    for index, partition in enumerate(partitions):
        counting = [c for c in partition.controls if spread[c] == 0 or not rig.controls[c].is_shape_key]
        counts[index, counting] = True
    return counts
