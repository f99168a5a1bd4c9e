# SPDX-License-Identifier: GPL-3.0-or-later
"""Detection of jumps of the mesh between similar poses, which no network can learn.

Two kinds of jumps are detected. Dual quaternions flip where a joint passes 180 degrees, and smoothing is undefined
where a ring of vertices has collapsed. Among poses that are similar in one joint, pairs on two sides of 180 degrees are
compared with pairs on the same side; other joints affect both alike. All other jumps, such as those of drivers that
switch or of nearest points that change, show only between poses that are similar in all inputs of a partition. These
are found only where a partition has few inputs.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..features import joint_features_in_metres
from ..partition import Partition
from ..recording.reader import Recording
from .residual_scan import ResidualScan
from .warning import RecordingWarning, format_length, joint_name

NEIGHBOR_COUNT = 4
"""Nearest poses that are compared with each pose."""
JOINT_DISTANCE_RATIO, INPUT_DISTANCE_RATIO = 0.2, 0.1
"""Poses are similar, in one joint or in all inputs, below this ratio of the median distance of two poses."""
MIN_PAIRS = 10
"""Smallest number of pairs from which usual distances are estimated."""
HALF_TURN_JUMP_RATIO, HALF_TURN_JUMP_PERCENTILE = 4.0, 95.0
"""Poses on two sides of 180 degrees jump when their median distance is above this multiple of the median distance of
poses on the same side, and above this percentile."""
JUMP_RATIO = 8.0
"""Poses that are similar in all inputs jump when their distance is above this multiple of the median of such pairs."""
MIN_SPREAD_RATIO, MIN_SIZE_RATIO = 1 / 3, 1e-3
"""A jump is at least this ratio of the largest distance of two poses, and this ratio of the rig's size."""
HALF_TURN_DEGREES = 150.0
"""Rotations by at least this angle are near 180 degrees, where the sign of a quaternion flips."""
MIN_DEVIATION = 1e-5
"""An element of a transform with a smaller standard deviation counts as constant."""
PAIR_BATCH = 512


@dataclass(frozen=True)
class Flip:
    """The jumps of one partition.

    Attributes:
        partition: index of the partition.
        joint: index of the joint that passes 180 degrees, -1 where none does.
        pairs: number of pairs of poses that jump.
        poses: indices of the two poses that are farthest apart.
        jump: distance of a vertex between these poses, mesh units.
    """

    partition: int
    joint: int
    pairs: int
    poses: tuple[int, int]
    jump: float


def check_flips(recording: Recording, scan: ResidualScan) -> list[RecordingWarning]:
    """Return the warning "flips" about the partition with the largest jump."""
    flips = find_flips(recording, scan)
    if not flips:
        return []
    worst, rig = max(flips, key=lambda flip: flip.jump), recording.rig
    jump = format_length(rig, worst.jump)
    pairs = "1 pair" if worst.pairs == 1 else f"{worst.pairs} pairs"
    others = len(flips) - 1
    too = f"; {others} more {'partition jumps' if others == 1 else 'partitions jump'} too" if others else ""
    where, advice = "", "look for what switches there, a driver or a Shrinkwrap, or leave that out of the range"
    if worst.joint >= 0:
        where = f", '{rig.joints[worst.joint].name}' on the two sides of 180 degrees"
        advice = "keep its rotation below 180 degrees, where Preserve Volume flips"
    text = (
        f"Vertices of '{joint_name(rig, recording.partitions[worst.partition].joint)}' jump up to {jump} "
        f"between similar poses{where} ({pairs}, such as poses {worst.poses[0]} and {worst.poses[1]}){too}, and "
        f"no network can learn a jump: {advice}, and record again."
    )
    return [RecordingWarning("flips", text)]


def find_flips(recording: Recording, scan: ResidualScan) -> list[Flip]:
    """Find the largest jump of each partition that has jumps."""
    rig, flips_found = recording.rig, []
    features = joint_features_in_metres(np.array(recording.pose_matrices[scan.poses]), rig)
    controls = np.array(recording.controls[scan.poses])
    pairs_by_joint = {j: pairs for j, pairs in _half_turn_pairs(features, recording.partitions) if len(pairs[0])}
    for partition_index, (partition, residuals) in enumerate(zip(recording.partitions, scan.residuals, strict=True)):
        spread = float(np.linalg.norm(np.ptp(residuals, axis=0), axis=1).max(initial=0))
        if spread < MIN_SIZE_RATIO * rig.size:
            continue
        min_jump = max(MIN_SPREAD_RATIO * spread, MIN_SIZE_RATIO * rig.size)
        flips = [
            _make_flip(partition_index, joint, scan.poses, across, jumps)
            for joint in partition.influencing
            if joint in pairs_by_joint
            for across, beside in [pairs_by_joint[joint]]
            for jumps in [_max_distances(residuals, across)]
            if np.median(jumps) > max(min_jump, *_largest_usual_jumps(_max_distances(residuals, beside)))
        ]
        if not flips and (similar := _similar_in_all_inputs(partition, features, controls)) is not None:
            jumps = _max_distances(residuals, similar)
            far = jumps > max(JUMP_RATIO * float(np.median(jumps)), min_jump)
            flips = [_make_flip(partition_index, -1, scan.poses, similar[far], jumps[far])] if far.any() else []
        flips_found += sorted(flips, key=lambda flip: -flip.jump)[:1]
    return flips_found


def _make_flip(partition: int, joint: int, poses: np.ndarray, pairs: np.ndarray, jumps: np.ndarray) -> Flip:
    a, b = sorted(poses[pairs[jumps.argmax()]].tolist())
    return Flip(partition, joint, len(pairs), (a, b), float(jumps.max()))


def _largest_usual_jumps(jumps: np.ndarray) -> tuple[float, float]:
    """Return two upper limits for distances of poses on the same side of 180 degrees."""
    return HALF_TURN_JUMP_RATIO * float(np.median(jumps)), float(np.percentile(jumps, HALF_TURN_JUMP_PERCENTILE))


def _half_turn_pairs(
    features: np.ndarray, partitions: tuple[Partition, ...]
) -> Iterator[tuple[int, tuple[np.ndarray, np.ndarray]]]:
    """Yield each joint that passes 180 degrees, with the pairs of similar poses on two sides and on the same side."""
    for joint in sorted({j for partition in partitions for j in partition.influencing}):
        quaternions = _quaternions(features[:, joint])
        near_half = quaternions[:, 0] < np.cos(np.radians(HALF_TURN_DEGREES / 2))
        if near_half.sum() < 2:
            continue
        pairs = find_similar_poses(features[:, joint], JOINT_DISTANCE_RATIO)
        a, b = pairs.T
        across = near_half[a] & near_half[b] & (np.einsum("mq,mq->m", quaternions[a], quaternions[b]) < 0)
        if (~across).sum() >= MIN_PAIRS:
            yield joint, (pairs[across], pairs[~across])


def _quaternions(features: np.ndarray) -> np.ndarray:
    """Convert (n, 12) features of a joint to (n, 4) rotation quaternions with w >= 0.

    Source: Bar-Itzhack, New Method for Extracting the Quaternion from a Rotation Matrix, 2000.
    """
    matrices = features.reshape(-1, 3, 4)[:, :, :3].astype(np.float64)
    u, _, v = np.linalg.svd(matrices)
    r = u @ v * np.linalg.det(u @ v)[:, None, None]
    # The eigenvector of the largest eigenvalue is well-defined at 180 degrees, too.
    k = np.zeros((len(r), 4, 4))
    k[:, 0, 0] = np.trace(r, axis1=1, axis2=2)
    k[:, 1:, 1:] = r + r.transpose(0, 2, 1) - k[:, :1, :1] * np.eye(3)
    for i, (x, y) in enumerate(((2, 1), (0, 2), (1, 0)), 1):
        k[:, 0, i] = k[:, i, 0] = r[:, x, y] - r[:, y, x]
    quaternions = np.linalg.eigh(k)[1][:, :, -1]
    return quaternions * np.where(quaternions[:, :1] < 0, -1, 1)


def _similar_in_all_inputs(partition: Partition, features: np.ndarray, controls: np.ndarray) -> np.ndarray | None:
    """Find pairs of poses that are similar in all inputs of a partition; None where there are too few."""
    joints = features[:, list(partition.influencing)].reshape(len(features), -1)
    inputs = np.concatenate([joints, controls[:, list(partition.controls)]], axis=1)
    pairs = find_similar_poses(inputs, INPUT_DISTANCE_RATIO)
    return pairs if len(pairs) >= MIN_PAIRS else None


def find_similar_poses(values: np.ndarray, max_ratio: float) -> np.ndarray:
    """Find pairs of poses that are similar but not equal.

    Args:
        values: (n, F) features; each is standardized, constant ones are ignored.
        max_ratio: largest distance of similar poses, as a ratio of the median distance.

    Returns:
        (m, 2) int64 pairs of indices, each once.
    """
    values = values.astype(np.float64)
    scale = values.std(axis=0)
    varying = scale > MIN_DEVIATION
    if not varying.any() or len(values) <= NEIGHBOR_COUNT + 1:
        return np.zeros((0, 2), np.int64)
    values = (values[:, varying] - values[:, varying].mean(axis=0)) / scale[varying]
    squares = np.einsum("nf,nf->n", values, values)
    distances = np.maximum(squares[:, None] + squares - 2 * values @ values.T, 0)
    largest = max_ratio**2 * np.median(distances[:: 1 + len(values) // 100])
    # Equal poses show no jump between different ones.
    distances[distances < MIN_DEVIATION] = np.inf
    nearest = np.argpartition(distances, NEIGHBOR_COUNT, axis=1)[:, :NEIGHBOR_COUNT]
    poses = np.repeat(np.arange(len(values)), NEIGHBOR_COUNT)
    is_similar = distances[poses, nearest.ravel()] < largest
    return np.unique(np.sort(np.stack([poses, nearest.ravel()], axis=1)[is_similar], axis=1), axis=0)


def _max_distances(residuals: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Compute the largest distance of a vertex of (n, S, 3) residuals in each of (m, 2) pairs; (m,) float64."""
    jumps = np.zeros(len(pairs))
    for start in range(0, len(pairs), PAIR_BATCH):
        a, b = pairs[start : start + PAIR_BATCH].T
        apart = residuals[a] - residuals[b]
        jumps[start : start + PAIR_BATCH] = np.sqrt(np.einsum("mvc,mvc->mv", apart, apart).max(axis=1, initial=0))
    return jumps
