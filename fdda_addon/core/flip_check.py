# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether the mesh jumps between poses that are alike: no network follows a jump.

Dual quaternions turn the other way round beyond 180 degrees, smoothing has no direction where a ring has collapsed,
and drivers switch. Each influencing joint is looked at by itself: with many of them, no two poses are alike in all, but
a jump stands out of what the others do.
"""

from dataclasses import dataclass

import numpy as np

from .features import joint_features
from .recording import Recording
from .recording_warning import RecordingWarning, joint_name, length
from .residual_scan import ResidualScan

NEIGHBOURS = 4
NEAR = 0.2
"""Neighbours are alike below this part of the median distance of two poses."""
JUMP = 8.0
"""A jump is so many times as far as the median of what alike poses differ by,"""
LEAST_OF_SPREAD = 1 / 3
"""and at least this part of the farthest that two poses are apart, in the partition,"""
LEAST_OF_SIZE = 1e-3
"""and this part of the character's size."""
LEAST_SPREAD = 1e-5
"""An element of a transform that spreads less over the poses counts as constant."""
PAIRS_AT_ONCE = 512


@dataclass(frozen=True)
class Flip:
    """The jumps of one partition between poses that are alike in one input.

    Attributes:
        partition: number of the partition.
        input: name of the joint or control.
        pairs: how many pairs of poses jump.
        poses: the pair that is farthest apart, indices into the recording.
        jump: how far, metres.
    """

    partition: int
    input: str
    pairs: int
    poses: tuple[int, int]
    jump: float


def check_flips(recording: Recording, scan: ResidualScan) -> list[RecordingWarning]:
    """The warning "flips", about the partition that jumps farthest."""
    flips = find_flips(recording, scan)
    if not flips:
        return []
    worst, rig = max(flips, key=lambda flip: flip.jump), recording.rig
    pairs = "1 pair" if worst.pairs == 1 else f"{worst.pairs} pairs"
    others = len(flips) - 1
    too = f"; {others} more {'partition jumps' if others == 1 else 'partitions jump'} too" if others else ""
    advice = (
        f"keep the turn of '{worst.input}' below 180 degrees, beyond which Preserve Volume turns the other way round"
        if worst.input in rig.joint_names
        else f"look for what '{worst.input}' switches, and give it a range that leaves that out"
    )
    joint = joint_name(rig, recording.partitions[worst.partition].joint)
    text = (
        f"Vertices of '{joint}' jump up to {length(worst.jump)} between poses that are alike in '{worst.input}' "
        f"({pairs}, such as poses {worst.poses[0]} and {worst.poses[1]}){too}, and no network follows a jump: "
        f"{advice}, and record again."
    )
    return [RecordingWarning("flips", text)]


def find_flips(recording: Recording, scan: ResidualScan) -> list[Flip]:
    """The jumps of every partition, those of its worst input each."""
    rig, found = recording.rig, []
    features = joint_features(np.array(recording.pose_matrices[scan.poses]), rig.rest_matrices, rig.parents)
    controls = np.array(recording.controls[scan.poses])
    least = LEAST_OF_SIZE * rig.size
    neighbours: dict[tuple[str, int], np.ndarray] = {}
    for number, (partition, residuals) in enumerate(zip(recording.partitions, scan.residuals, strict=True)):
        spread = float(np.linalg.norm(np.ptp(residuals, axis=0), axis=1).max(initial=0))
        if spread < least:
            continue
        seen = {("joint", j): (rig.joints[j].name, features[:, j]) for j in partition.influencing}
        seen |= {("control", c): (rig.controls[c].name, controls[:, c : c + 1]) for c in partition.controls}
        flips = []
        for key, (name, values) in seen.items():
            if key not in neighbours:
                neighbours[key] = alike_poses(values)
            pairs = neighbours[key]
            jumps = _jumps(residuals, pairs)
            limit = max(JUMP * np.median(jumps), LEAST_OF_SPREAD * spread, least) if len(jumps) else np.inf
            if count := int((jumps > limit).sum()):
                a, b = sorted(scan.poses[pairs[jumps.argmax()]].tolist())
                flips.append(Flip(number, name, count, (a, b), float(jumps.max())))
        if flips:
            found.append(max(flips, key=lambda flip: flip.pairs))
    return found


def alike_poses(values: np.ndarray) -> np.ndarray:
    """Pairs of poses that are near to each other in some features.

    Args:
        values: (n, F) features; those that vary count equally.

    Returns:
        (m, 2) int64 pairs, each once: nearest neighbours that are near.
    """
    values = values.astype(np.float64)
    scale = values.std(axis=0)
    varying = scale > LEAST_SPREAD
    if not varying.any() or len(values) <= NEIGHBOURS + 1:
        return np.zeros((0, 2), np.int64)
    values = (values[:, varying] - values[:, varying].mean(axis=0)) / scale[varying]
    squares = np.einsum("nf,nf->n", values, values)
    distances = np.maximum(squares[:, None] + squares - 2 * values @ values.T, 0)
    near = NEAR**2 * np.median(distances[:: 1 + len(values) // 100])
    # Equal poses say nothing of a jump between different ones.
    distances[distances < LEAST_SPREAD] = np.inf
    nearest = np.argpartition(distances, NEIGHBOURS, axis=1)[:, :NEIGHBOURS]
    own = np.repeat(np.arange(len(values)), NEIGHBOURS)
    pairs = np.sort(np.stack([own, nearest.ravel()], axis=1)[distances[own, nearest.ravel()] < near], axis=1)
    return np.unique(pairs, axis=0)


def _jumps(residuals: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """(m,) float64, how far the farthest vertex of (n, S, 3) residuals moves between the poses of each pair."""
    jumps = np.zeros(len(pairs))
    for start in range(0, len(pairs), PAIRS_AT_ONCE):
        a, b = pairs[start : start + PAIRS_AT_ONCE].T
        apart = residuals[a] - residuals[b]
        jumps[start : start + PAIRS_AT_ONCE] = np.sqrt(np.einsum("mvc,mvc->mv", apart, apart).max(axis=1, initial=0))
    return jumps
