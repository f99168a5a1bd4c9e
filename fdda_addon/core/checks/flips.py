# SPDX-License-Identifier: GPL-3.0-or-later
"""Detection of jumps of the mesh between similar poses, which no network can learn.

Two kinds of jumps are detected:

- Jumps at a rotation of 180 degrees: dual quaternions flip there, and smoothing is undefined where a ring of vertices
  has collapsed. Among poses that are similar in one joint, pairs of poses on two sides of 180 degrees are compared with
  pairs on the same side. Other joints affect both kinds of pairs equally.
- All other jumps, for instance where a driver switches or a nearest point changes. They are visible only between poses
  that are similar in all inputs of a partition, and such poses exist only where a partition has few inputs.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..mathematics.features import joint_features_in_metres
from ..mathematics.partition import Partition
from ..recording.skinned import SkinnedRecording
from ..wording import format_count
from .residual_scan import ResidualScan
from .warning import RecordingWarning, format_length, joint_name

NEIGHBOR_COUNT = 4
"""Number of nearest poses with which each pose is compared."""
JOINT_DISTANCE_RATIO, INPUT_DISTANCE_RATIO = 0.2, 0.1
"""Two poses are similar, in one joint or in all inputs, where their distance is below this ratio of the median distance
of two poses."""
MIN_PAIRS = 10
"""Smallest number of pairs of poses from which the usual distance is estimated."""
HALF_TURN_JUMP_RATIO, HALF_TURN_JUMP_PERCENTILE = 4.0, 95.0
"""The mesh jumps at 180 degrees where the median distance of poses on two sides exceeds both limits: this multiple of
the median distance on the same side, and this percentile of the distances there."""
JUMP_RATIO = 8.0
"""The mesh jumps between two poses that are similar in all inputs where their distance is above this multiple of the
median distance of such pairs."""
MIN_SPREAD_RATIO, MIN_SIZE_RATIO = 1 / 3, 1e-3
"""Smallest size of a jump, as a ratio of the largest distance of two poses, and as a ratio of the rig's size."""
MAX_TRACE = 1 + 2 * np.cos(np.radians(150.0))
"""Trace of a matrix that rotates by 150 degrees. Larger rotations are near 180 degrees, where quaternions flip."""
MIN_DEVIATION = 1e-5
"""An element of a transform with a smaller standard deviation counts as constant."""
PAIR_BATCH = 512
"""Number of pairs of poses whose residuals are compared at once."""


@dataclass(frozen=True)
class Flip:
    """The jumps of one partition.

    Attributes:
        partition: index of the partition.
        joint: index of the joint that passes 180 degrees; -1 where no joint does.
        pairs: number of pairs of poses between which the mesh jumps.
        poses: indices of the two poses with the largest jump.
        jump: largest distance of a vertex between these two poses, mesh units.
    """

    partition: int
    joint: int
    pairs: int
    poses: tuple[int, int]
    jump: float


def check_flips(recording: SkinnedRecording, scan: ResidualScan) -> list[RecordingWarning]:
    """Return the warning "flips" about the partition with the largest jump."""
    flips = find_flips(recording, scan)
    if not flips:
        return []
    worst_flip, rig = max(flips, key=lambda flip: flip.jump), recording.rig
    jump_text = format_length(rig, worst_flip.jump)
    other_count = len(flips) - 1
    others_text = (
        f"; {other_count} more {'partition jumps' if other_count == 1 else 'partitions jump'} too"
        if other_count
        else ""
    )
    joint_text, advice = "", "look for what switches there, a driver or a Shrinkwrap, or leave that out of the range"
    if worst_flip.joint >= 0:
        joint_text = f", '{rig.joints[worst_flip.joint].name}' on the two sides of 180 degrees"
        advice = "keep its rotation below 180 degrees, where Preserve Volume flips"
    text = (
        f"Vertices of '{joint_name(rig, recording.partitions[worst_flip.partition].joint)}' jump up to {jump_text} "
        f"between similar poses{joint_text} ({format_count(worst_flip.pairs, 'pair')}, such as poses "
        f"{worst_flip.poses[0]} and {worst_flip.poses[1]}){others_text}, and no network can learn a jump: {advice}, "
        "and record again."
    )
    return [RecordingWarning("flips", text)]


def find_flips(recording: SkinnedRecording, scan: ResidualScan) -> list[Flip]:
    """Find the largest jump of each partition that has jumps."""
    rig, flips_found = recording.rig, []
    features = joint_features_in_metres(np.array(recording.pose_matrices[scan.poses]), rig)
    controls = np.array(recording.controls[scan.poses])
    pairs_by_joint = {j: pairs for j, pairs in _find_half_turn_pairs(features, recording.partitions) if len(pairs[0])}
    for partition_index, (partition, residuals) in enumerate(zip(recording.partitions, scan.residuals, strict=True)):
        spread = float(np.linalg.norm(np.ptp(residuals, axis=0), axis=1).max(initial=0))
        if spread < MIN_SIZE_RATIO * rig.size:
            continue
        min_jump = max(MIN_SPREAD_RATIO * spread, MIN_SIZE_RATIO * rig.size)
        flips = []
        for joint in (joint for joint in partition.influencing if joint in pairs_by_joint):
            opposite_pairs, same_side_pairs = pairs_by_joint[joint]
            jumps, usual_jumps = (_max_distances(residuals, pairs) for pairs in (opposite_pairs, same_side_pairs))
            usual_limit = max(
                HALF_TURN_JUMP_RATIO * np.median(usual_jumps), np.percentile(usual_jumps, HALF_TURN_JUMP_PERCENTILE)
            )
            if np.median(jumps) > max(min_jump, usual_limit):
                flips.append(_make_flip(partition_index, joint, scan.poses, opposite_pairs, jumps))
        joint_inputs = features[:, list(partition.influencing)].reshape(len(features), -1)
        inputs = np.concatenate([joint_inputs, controls[:, list(partition.controls)]], axis=1)
        if not flips and len(pairs := find_similar_poses(inputs, INPUT_DISTANCE_RATIO)) >= MIN_PAIRS:
            jumps = _max_distances(residuals, pairs)
            is_jump = jumps > max(JUMP_RATIO * float(np.median(jumps)), min_jump)
            if is_jump.any():
                flips.append(_make_flip(partition_index, -1, scan.poses, pairs[is_jump], jumps[is_jump]))
        flips_found += sorted(flips, key=lambda flip: -flip.jump)[:1]
    return flips_found


def _make_flip(partition: int, joint: int, poses: np.ndarray, pairs: np.ndarray, jumps: np.ndarray) -> Flip:
    first, second = sorted(poses[pairs[jumps.argmax()]].tolist())
    return Flip(partition, joint, len(pairs), (first, second), float(jumps.max()))


def _find_half_turn_pairs(
    features: np.ndarray, partitions: tuple[Partition, ...]
) -> Iterator[tuple[int, tuple[np.ndarray, np.ndarray]]]:
    """Yield each joint that passes 180 degrees, with its pairs of similar poses on two sides and on the same side."""
    for joint in sorted({j for partition in partitions for j in partition.influencing}):
        u, _, v = np.linalg.svd(features[:, joint].reshape(-1, 3, 4)[:, :, :3].astype(np.float64))
        matrices = u @ v * np.linalg.det(u @ v)[:, None, None]
        is_near_half_turn = np.trace(matrices, axis1=1, axis2=2) < MAX_TRACE
        if is_near_half_turn.sum() < 2:
            continue
        # Near 180 degrees, these are small vectors along the axis, whose sign differs on the two sides.
        axes = np.stack([matrices[:, x, y] - matrices[:, y, x] for x, y in ((2, 1), (0, 2), (1, 0))], axis=1)
        pairs = find_similar_poses(features[:, joint], JOINT_DISTANCE_RATIO)
        first, second = pairs.T
        is_opposite = (
            is_near_half_turn[first]
            & is_near_half_turn[second]
            & (np.einsum("mc,mc->m", axes[first], axes[second]) < 0)
        )
        if (~is_opposite).sum() >= MIN_PAIRS:
            yield joint, (pairs[is_opposite], pairs[~is_opposite])


def find_similar_poses(values: np.ndarray, max_ratio: float) -> np.ndarray:
    """Find pairs of poses that are similar but not equal.

    Args:
        values: (n, F) features. Each feature is standardized; constant features are ignored.
        max_ratio: largest distance of similar poses, as a ratio of the median distance.

    Returns:
        (m, 2) int64 pairs of indices; each pair occurs once.
    """
    values = values.astype(np.float64)
    deviations = values.std(axis=0)
    is_varying = deviations > MIN_DEVIATION
    if not is_varying.any() or len(values) <= NEIGHBOR_COUNT + 1:
        return np.zeros((0, 2), np.int64)
    values = (values[:, is_varying] - values[:, is_varying].mean(axis=0)) / deviations[is_varying]
    squared_norms = np.einsum("nf,nf->n", values, values)
    squared_distances = np.maximum(squared_norms[:, None] + squared_norms - 2 * values @ values.T, 0)
    max_squared_distance = max_ratio**2 * np.median(squared_distances[:: 1 + len(values) // 100])
    # Between equal poses there is no jump that depends on the pose.
    squared_distances[squared_distances < MIN_DEVIATION] = np.inf
    nearest = np.argpartition(squared_distances, NEIGHBOR_COUNT, axis=1)[:, :NEIGHBOR_COUNT]
    poses = np.repeat(np.arange(len(values)), NEIGHBOR_COUNT)
    is_similar = squared_distances[poses, nearest.ravel()] < max_squared_distance
    return np.unique(np.sort(np.stack([poses, nearest.ravel()], axis=1)[is_similar], axis=1), axis=0)


def _max_distances(residuals: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Compute the largest distance of a vertex between the poses of each pair.

    Args:
        residuals: (n, S, 3) residuals of S vertices in n poses, mesh units.
        pairs: (m, 2) indices of poses.

    Returns:
        (m,) float64, mesh units.
    """
    jumps = np.zeros(len(pairs))
    for start in range(0, len(pairs), PAIR_BATCH):
        first, second = pairs[start : start + PAIR_BATCH].T
        differences = residuals[first] - residuals[second]
        jumps[start : start + PAIR_BATCH] = np.sqrt(
            np.einsum("mvc,mvc->mv", differences, differences).max(axis=1, initial=0)
        )
    return jumps
