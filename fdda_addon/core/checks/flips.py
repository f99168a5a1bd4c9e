# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether the mesh jumps between poses that are alike: no network follows a jump.

Looked for in two ways. Dual quaternions turn the other way round where a joint passes 180 degrees, and smoothing has no
direction where a ring has collapsed: of the poses that are alike in one joint, those on the two sides of 180 degrees
are compared with those on one side; what the other joints do, they do to both. Other jumps, of drivers that switch and
of nearest points that become others, show only between poses that are alike in all inputs of a partition, so where
these are few.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..features import joint_features_in_metres
from ..partition import Partition
from ..recording.reader import Recording
from .residual_scan import ResidualScan
from .warning import RecordingWarning, joint_name, length

NEIGHBOURS = 4
NEAR_IN_ONE, NEAR_IN_ALL = 0.2, 0.1
"""Neighbours are alike below this part of the median distance of two poses."""
MIN_PAIRS = 10
"""Fewer pairs of alike poses say nothing of what is usual."""
TURN_JUMP, TURN_SHARE = 4.0, 95.0
"""Poses on two sides of 180 degrees jump when their median distance is at least this multiple of the median distance of
poses on one side, and above this percentile of it."""
JUMP = 8.0
"""Poses that are alike in all inputs jump when their distance is at least this multiple of the median of such poses."""
MIN_PART_OF_SPREAD, MIN_PART_OF_SIZE = 1 / 3, 1e-3
"""A jump of either kind is at least this part of the largest distance of two poses, and of the character's size."""
HALF_TURN = 150.0
"""Degrees from which on a rotation is near a half turn, where its sign flips."""
MIN_SPREAD = 1e-5
"""An element of a transform that spreads less over the poses counts as constant."""
PAIRS_AT_ONCE = 512


@dataclass(frozen=True)
class Flip:
    """The jumps of one partition.

    Attributes:
        partition: number of the partition.
        joint: the joint that passes 180 degrees, -1 where none does.
        pairs: how many pairs of poses jump.
        poses: the pair that is farthest apart, indices into the recording.
        jump: how far, metres.
    """

    partition: int
    joint: int
    pairs: int
    poses: tuple[int, int]
    jump: float


def check_flips(recording: Recording, scan: ResidualScan) -> list[RecordingWarning]:
    """The warning "flips", about the partition that jumps farthest."""
    flips = find_flips(recording, scan)
    if not flips:
        return []
    worst, rig = max(flips, key=lambda flip: flip.jump), recording.rig
    jump = length(rig, worst.jump)
    pairs = "1 pair" if worst.pairs == 1 else f"{worst.pairs} pairs"
    others = len(flips) - 1
    too = f"; {others} more {'partition jumps' if others == 1 else 'partitions jump'} too" if others else ""
    where, advice = "", "look for what switches there, a driver or a Shrinkwrap, or leave that out of the range"
    if worst.joint >= 0:
        where = f", '{rig.joints[worst.joint].name}' on the two sides of 180 degrees"
        advice = "keep its turn below 180 degrees, beyond which Preserve Volume turns the other way round"
    text = (
        f"Vertices of '{joint_name(rig, recording.partitions[worst.partition].joint)}' jump up to {jump} "
        f"between poses that are alike{where} ({pairs}, such as poses {worst.poses[0]} and {worst.poses[1]}){too}, and "
        f"no network follows a jump: {advice}, and record again."
    )
    return [RecordingWarning("flips", text)]


def find_flips(recording: Recording, scan: ResidualScan) -> list[Flip]:
    """The jumps of every partition that has some."""
    rig, found = recording.rig, []
    features = joint_features_in_metres(np.array(recording.pose_matrices[scan.poses]), rig)
    controls = np.array(recording.controls[scan.poses])
    turned = {j: pairs for j, pairs in _pairs_of_joints(features, recording.partitions) if len(pairs[0])}
    for number, (partition, residuals) in enumerate(zip(recording.partitions, scan.residuals, strict=True)):
        spread = float(np.linalg.norm(np.ptp(residuals, axis=0), axis=1).max(initial=0))
        if spread < MIN_PART_OF_SIZE * rig.size:
            continue
        least = max(MIN_PART_OF_SPREAD * spread, MIN_PART_OF_SIZE * rig.size)
        flips = [
            _flip(number, joint, scan.poses, across, jumps)
            for joint in partition.influencing
            if joint in turned
            for across, beside in [turned[joint]]
            for jumps in [_jumps(residuals, across)]
            if np.median(jumps) > max(least, *_usual(_jumps(residuals, beside)))
        ]
        if not flips and (alike := _alike_in_all(partition, features, controls)) is not None:
            jumps = _jumps(residuals, alike)
            far = jumps > max(JUMP * float(np.median(jumps)), least)
            flips = [_flip(number, -1, scan.poses, alike[far], jumps[far])] if far.any() else []
        found += sorted(flips, key=lambda flip: -flip.jump)[:1]
    return found


def _flip(partition: int, joint: int, poses: np.ndarray, pairs: np.ndarray, jumps: np.ndarray) -> Flip:
    a, b = sorted(poses[pairs[jumps.argmax()]].tolist())
    return Flip(partition, joint, len(pairs), (a, b), float(jumps.max()))


def _usual(jumps: np.ndarray) -> tuple[float, float]:
    """What poses on one side of 180 degrees may be apart, and poses on two sides not."""
    return TURN_JUMP * float(np.median(jumps)), float(np.percentile(jumps, TURN_SHARE))


def _pairs_of_joints(
    features: np.ndarray, partitions: tuple[Partition, ...]
) -> Iterator[tuple[int, tuple[np.ndarray, np.ndarray]]]:
    """Each joint that passes 180 degrees, with the pairs of alike poses on the two sides and on one side of it."""
    for joint in sorted({j for partition in partitions for j in partition.influencing}):
        quaternions = _quaternions(features[:, joint])
        near_half = quaternions[:, 0] < np.cos(np.radians(HALF_TURN / 2))
        if near_half.sum() < 2:
            continue
        pairs = alike_poses(features[:, joint], NEAR_IN_ONE)
        a, b = pairs.T
        across = near_half[a] & near_half[b] & (np.einsum("mq,mq->m", quaternions[a], quaternions[b]) < 0)
        if (~across).sum() >= MIN_PAIRS:
            yield joint, (pairs[across], pairs[~across])


def _quaternions(features: np.ndarray) -> np.ndarray:
    """(n, 12) features of a joint to (n, 4) quaternions of its turn, the first element 0 or more."""
    matrices = features.reshape(-1, 3, 4)[:, :, :3].astype(np.float64)
    u, _, v = np.linalg.svd(matrices)
    r = u @ v * np.linalg.det(u @ v)[:, None, None]
    # The eigenvector of the largest eigenvalue (Bar-Itzhack 2000): well-defined at 180 degrees too.
    k = np.zeros((len(r), 4, 4))
    k[:, 0, 0] = np.trace(r, axis1=1, axis2=2)
    k[:, 1:, 1:] = r + r.transpose(0, 2, 1) - k[:, :1, :1] * np.eye(3)
    for i, (x, y) in enumerate(((2, 1), (0, 2), (1, 0)), 1):
        k[:, 0, i] = k[:, i, 0] = r[:, x, y] - r[:, y, x]
    found = np.linalg.eigh(k)[1][:, :, -1]
    return found * np.where(found[:, :1] < 0, -1, 1)


def _alike_in_all(partition: Partition, features: np.ndarray, controls: np.ndarray) -> np.ndarray | None:
    """Pairs of poses that are alike in all that a partition depends on, None when they are too few."""
    own = features[:, list(partition.influencing)].reshape(len(features), -1)
    pairs = alike_poses(np.concatenate([own, controls[:, list(partition.controls)]], axis=1), NEAR_IN_ALL)
    return pairs if len(pairs) >= MIN_PAIRS else None


def alike_poses(values: np.ndarray, near: float) -> np.ndarray:
    """Pairs of poses that are near to each other in some features, but not equal.

    Args:
        values: (n, F) features; those that vary count equally.
        near: largest distance, as a part of the median.

    Returns:
        (m, 2) int64 pairs, each once: nearest neighbours that are near.
    """
    values = values.astype(np.float64)
    scale = values.std(axis=0)
    varying = scale > MIN_SPREAD
    if not varying.any() or len(values) <= NEIGHBOURS + 1:
        return np.zeros((0, 2), np.int64)
    values = (values[:, varying] - values[:, varying].mean(axis=0)) / scale[varying]
    squares = np.einsum("nf,nf->n", values, values)
    distances = np.maximum(squares[:, None] + squares - 2 * values @ values.T, 0)
    largest = near**2 * np.median(distances[:: 1 + len(values) // 100])
    # Equal poses say nothing of a jump between different ones.
    distances[distances < MIN_SPREAD] = np.inf
    nearest = np.argpartition(distances, NEIGHBOURS, axis=1)[:, :NEIGHBOURS]
    own = np.repeat(np.arange(len(values)), NEIGHBOURS)
    found = distances[own, nearest.ravel()] < largest
    return np.unique(np.sort(np.stack([own, nearest.ravel()], axis=1)[found], axis=1), axis=0)


def _jumps(residuals: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """(m,) float64, how far the farthest vertex of (n, S, 3) residuals moves between the poses of each pair."""
    jumps = np.zeros(len(pairs))
    for start in range(0, len(pairs), PAIRS_AT_ONCE):
        a, b = pairs[start : start + PAIRS_AT_ONCE].T
        apart = residuals[a] - residuals[b]
        jumps[start : start + PAIRS_AT_ONCE] = np.sqrt(np.einsum("mvc,mvc->mv", apart, apart).max(axis=1, initial=0))
    return jumps
