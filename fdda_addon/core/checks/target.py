# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether what a target showed can be learnt: poses that did not settle, frames that jump or stand still, its place."""

from collections.abc import Iterator

import numpy as np

from ..recording.index import ACTION, STRIP, Source
from ..recording.reader import Recording
from ..skinning import LinearSkinning
from .warning import RecordingWarning, length, listed

MAX_APART = 0.2
"""Two ways to one pose may be apart by this part of what linear skinning is off by; a model would learn no more."""
JUMP, MIN_JUMP = 8.0, 0.01
"""A frame jumps when the target moves against linear skinning by so many times the median of such moves of the action,
and by more than this part of the character's size."""
FROZEN, MOVES = 1e-6, 1e-3
"""Parts of the character's size: the target stands still where it moves by less than the first from a frame to the next
while its linear skinning moves by more than the second."""
MAX_FRAMES = 2000
"""Frames beyond so many are not looked at."""
MAX_POSES = 50
"""Of poses far apart the place and size of the target are taken."""
MAX_SCALE, MAX_OFF = 1.5, 0.25
"""A target that is larger or smaller by this factor, or whose middle is off by this part of the size, is elsewhere."""


def check_target(recording: Recording) -> list[RecordingWarning]:
    """Warnings "hysteresis", "frame-jumps", "frozen-frames" and "target-place"; none where there is no target."""
    if recording.info.target is None:
        return []
    skinning = LinearSkinning(recording.rig, recording.partitions)
    return [*_check_repeatability(recording), *_check_frames(recording, skinning), *_check_place(recording, skinning)]


def _check_repeatability(recording: Recording) -> list[RecordingWarning]:
    repeatability = recording.info.repeatability
    if repeatability is None or repeatability.distance_mm["mean"] <= MAX_APART * repeatability.linear_mm:
        return []
    text = (
        f"The target is {repeatability.distance_mm['mean']:.2g} mm from itself when the same pose is reached from "
        f"another direction, on average over {len(repeatability.poses)} poses, and linear skinning is "
        f"{repeatability.linear_mm:.2g} mm off: no model can be closer; hold poses for more frames or play actions "
        "slower, damp the simulation, or leave folds to another mesh."
    )
    return [RecordingWarning("hysteresis", text)]


def _check_frames(recording: Recording, skinning: LinearSkinning) -> list[RecordingWarning]:
    """Frames of actions that jump, or in which the target stands still."""
    jumps, frozen = [], []
    first = 0
    for source in recording.info.sampling.sources:
        if source.kind in (ACTION, STRIP) and source.poses > 2:
            moved, linear = _moves(recording, skinning, first, min(source.poses, MAX_FRAMES))
            size = recording.rig.size
            still = np.flatnonzero((moved[:, 0] < FROZEN * size) & (linear > MOVES * size)) + 1
            frozen += [_frame(source, number) for number in still.tolist()]
            # What stands still while the rig moves does not jump.
            beside = moved.min(axis=1)
            jumping = np.flatnonzero((beside > JUMP * np.median(beside)) & (beside > MIN_JUMP * size)) + 1
            jumps += [(_frame(source, number), float(beside[number - 1])) for number in jumping.tolist()]
        first += source.poses
    found = []
    if frozen:
        text = (
            f"The target stands still in {len(frozen)} frames in which the rig moves: {listed(frozen)}: its cache ends "
            "before, or begins after; record frames that it has."
        )
        found.append(RecordingWarning("frozen-frames", text))
    if jumps:
        jumps.sort(key=lambda jump: -jump[1])
        text = (
            f"The target jumps in {len(jumps)} frames, by up to {length(recording.rig, jumps[0][1])} from one frame to "
            f"the next: {listed([name for name, _ in jumps])}: look at the simulation there, or leave these frames out."
        )
        found.append(RecordingWarning("frame-jumps", text))
    return found


def _frame(source: Source, number: int) -> str:
    return f"{source.name} {source.frames[0] + number}"


def _moves(recording: Recording, skinning: LinearSkinning, first: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """How far vertices move from each frame to the next, the farthest of each frame.

    Returns:
        (count - 1, 2) of the target, and of the target beside its linear skinning; (count - 1,) of linear skinning.
    """
    moved, linear, before = [], [], None
    for positions, skinned in _shown(recording, skinning, range(first, first + count)):
        now = positions, skinned
        if before is not None:
            whole, rest = positions - before[0], skinned - before[1]
            moved.append([_farthest(whole), _farthest(whole - rest)])
            linear.append(_farthest(rest))
        before = now
    return np.array(moved), np.array(linear)


def _shown(recording: Recording, skinning: LinearSkinning, poses: range) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """(V, 3) positions of the target and of linear skinning in some poses."""
    for pose in poses:
        matrices = np.array(recording.pose_matrices[pose])[None]
        residuals = np.array(recording.residuals[pose])[None]
        yield skinning.complex_positions(matrices, residuals)[0], skinning.positions(matrices)[0]


def _farthest(offsets: np.ndarray) -> float:
    return float(np.sqrt(np.einsum("vc,vc->v", offsets, offsets).max()))


def _check_place(recording: Recording, skinning: LinearSkinning) -> list[RecordingWarning]:
    poses = range(0, len(recording.pose_matrices), max(1, len(recording.pose_matrices) // MAX_POSES))
    scales, offsets = [], []
    for positions, skinned in _shown(recording, skinning, poses):
        middles = positions.mean(axis=0), skinned.mean(axis=0)
        extents = [np.sqrt(((own - middle) ** 2).sum(axis=1).mean()) for own, middle in
                   zip((positions, skinned), middles, strict=True)]  # fmt: skip
        scales.append(extents[0] / max(extents[1], 1e-12))
        offsets.append(np.linalg.norm(middles[0] - middles[1]))
    scale, off = float(np.median(scales)), float(np.median(offsets))
    if 1 / MAX_SCALE < scale < MAX_SCALE and off < MAX_OFF * recording.rig.size:
        return []
    text = (
        f"The target '{recording.info.target.object_name}' is {scale:.3g} times as large as linear skinning, and its "
        f"middle {length(recording.rig, off)} away: it is in other units or another place; scale and move it onto the "
        "mesh, and record again."
    )
    return [RecordingWarning("target-place", text)]


def unsettled_in_words(index: dict) -> str:
    """A sentence about the poses of a recording that did not come to rest; empty where all did.

    Args:
        index: as `read_index` gives it.
    """
    unsettled = index.get("unsettled", [])
    if not unsettled:
        return ""
    frames = index["target"]["max_settle_frames"]
    return (
        f"{len(unsettled)} of {index['complete']} poses did not come to rest in {frames} frames: "
        f"{listed(unsettled)}. A training leaves them out; more frames (--max-settle-frames) let them rest."
    )
