# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks of a recorded target: hysteresis, frames in which it jumps or is frozen, wrong scale or location."""

from collections.abc import Iterable, Iterator

import numpy as np

from ..mathematics.metrics import distances
from ..recording.index import ACTION, STRIP, Source, repeated_poses
from ..recording.skinned import SkinnedRecording
from ..wording import format_count, format_list
from .warning import RecordingWarning, format_length

MAX_DISTANCE_RATIO = 0.2
"""Largest distance between the shapes of a target in a pose that is reached from two directions, as a ratio of the
error of linear skinning."""
JUMP_RATIO, MIN_JUMP_RATIO = 8.0, 0.01
"""A target jumps in a frame where its motion relative to linear skinning exceeds two limits: this multiple of the
median motion in the action, and this ratio of the rig's size."""
MAX_FROZEN_RATIO, MIN_MOTION_RATIO = 1e-6, 1e-3
"""Ratios of the rig's size: a target is frozen where it moves by less than the first between two frames while linear
skinning moves by more than the second."""
MAX_CHECKED_FRAMES = 2000
"""Largest number of frames of an action that are checked."""
MAX_COMPARED_POSES = 50
"""Number of evenly spaced poses in which location and size of the target are measured."""
MAX_SCALE, MAX_OFFSET_RATIO = 1.5, 0.25
"""Largest differences between a target and linear skinning: factor of scale, and distance of the centers as a ratio of
the rig's size."""


def check_target(recording: SkinnedRecording) -> list[RecordingWarning]:
    """Return the warnings "hysteresis", "frame-jumps", "frozen-frames" and "target-place"; empty without a target."""
    if recording.info.target is None:
        return []
    return [*_check_repeatability(recording), *_check_frames(recording), *_check_location(recording)]


def is_frozen(target_motion: np.ndarray, linear_motion: np.ndarray, size: float) -> np.ndarray:
    """Return whether a target is frozen between two frames.

    Args:
        target_motion, linear_motion: largest motion of a vertex of the target and of linear skinning, mesh units.
        size: size of the rig, mesh units.
    """
    return (target_motion < MAX_FROZEN_RATIO * size) & (linear_motion > MIN_MOTION_RATIO * size)


def frozen_sentence(count: int) -> str:
    """Return a sentence about a number of compared poses in which a target is frozen; empty for 0."""
    if not count:
        return ""
    return (
        f"The target stands still in {format_count(count, 'pose')} in which the rig moves, and these count as errors: "
        "its cache ends before, or begins after; compare frames that it has."
    )


def _check_repeatability(recording: SkinnedRecording) -> list[RecordingWarning]:
    repeatability_mm = recording.info.repeatability_mm
    if repeatability_mm is None:
        return []
    pairs = _iterate_positions(recording, repeated_poses(recording.info.poses, recording.info.unsettled))
    linear_mm = 1000 * float(np.mean([distances(*pair, recording.rig.metres_per_unit).mean() for pair in pairs]))
    if repeatability_mm <= MAX_DISTANCE_RATIO * linear_mm:
        return []
    text = (
        f"The target is {repeatability_mm:.2g} mm from itself when the same pose is reached from another direction, on "
        f"average, and linear skinning is {linear_mm:.2g} mm off: no model can be closer; hold poses for more frames, "
        "damp the simulation, or leave folds to another mesh."
    )
    return [RecordingWarning("hysteresis", text)]


def _check_frames(recording: SkinnedRecording) -> list[RecordingWarning]:
    """Warn about frames of actions in which the target jumps or is frozen."""
    jumps, frozen = [], []
    first_pose = 0
    for source in recording.info.sampling.sources:
        if source.kind in (ACTION, STRIP) and source.poses > 2:
            target_motions, linear_motions = _largest_motions(
                recording, first_pose, min(source.poses, MAX_CHECKED_FRAMES)
            )
            size = recording.rig.size
            frozen_frames = np.flatnonzero(is_frozen(target_motions[:, 0], linear_motions, size)) + 1
            frozen += [_frame_label(source, frame_index) for frame_index in frozen_frames.tolist()]
            # A target that is frozen while the rig moves does not jump.
            jump_sizes = target_motions.min(axis=1)
            jumping_frames = (
                np.flatnonzero((jump_sizes > JUMP_RATIO * np.median(jump_sizes)) & (jump_sizes > MIN_JUMP_RATIO * size))
                + 1
            )
            jumps += [
                (_frame_label(source, frame_index), float(jump_sizes[frame_index - 1]))
                for frame_index in jumping_frames.tolist()
            ]
        first_pose += source.poses
    warnings = []
    if frozen:
        text = (
            f"The target '{recording.info.target.object_name}' stands still in {format_count(len(frozen), 'frame')} in "
            f"which the rig moves: {format_list(frozen)}: its cache ends before, or begins after; record frames that "
            "it has."
        )
        warnings.append(RecordingWarning("frozen-frames", text))
    if jumps:
        jumps.sort(key=lambda jump: -jump[1])
        text = (
            f"The target jumps in {format_count(len(jumps), 'frame')}, by up to "
            f"{format_length(recording.rig, jumps[0][1])} from one frame to the next: "
            f"{format_list([label for label, _ in jumps])}: look at the simulation there, or leave these frames out."
        )
        warnings.append(RecordingWarning("frame-jumps", text))
    return warnings


def _frame_label(source: Source, frame_index: int) -> str:
    return f"{source.name} {source.frames[0] + frame_index}"


def _largest_motions(recording: SkinnedRecording, first_pose: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Measure the largest motion of a vertex between consecutive frames.

    Returns:
        (count - 1, 2) motions of the target, absolute and relative to linear skinning; (count - 1,) motions of linear
        skinning. All are in mesh units.
    """
    target_motions, linear_motions, previous = [], [], None
    for positions, skinned in _iterate_positions(recording, range(first_pose, first_pose + count)):
        current = positions, skinned
        if previous is not None:
            target_offsets, linear_offsets = positions - previous[0], skinned - previous[1]
            target_motions.append([_max_length(target_offsets), _max_length(target_offsets - linear_offsets)])
            linear_motions.append(_max_length(linear_offsets))
        previous = current
    return np.array(target_motions), np.array(linear_motions)


def _iterate_positions(recording: SkinnedRecording, poses: Iterable[int]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield (V, 3) positions of the target and of linear skinning, mesh-object space, mesh units."""
    for pose in poses:
        yield (
            recording.read_positions(np.array([pose]))[0],
            recording.skinning.positions(recording.pose_matrices[[pose]])[0],
        )


def _max_length(offsets: np.ndarray) -> float:
    return float(np.sqrt(np.einsum("vc,vc->v", offsets, offsets).max()))


def _check_location(recording: SkinnedRecording) -> list[RecordingWarning]:
    poses = range(0, len(recording.pose_matrices), max(1, len(recording.pose_matrices) // MAX_COMPARED_POSES))
    scales, offsets = [], []
    for positions, skinned in _iterate_positions(recording, poses):
        centers = positions.mean(axis=0), skinned.mean(axis=0)
        extents = [np.sqrt(((vertices - center) ** 2).sum(axis=1).mean()) for vertices, center in
                   zip((positions, skinned), centers, strict=True)]  # fmt: skip
        scales.append(extents[0] / max(extents[1], 1e-12))
        offsets.append(np.linalg.norm(centers[0] - centers[1]))
    scale, offset = float(np.median(scales)), float(np.median(offsets))
    if 1 / MAX_SCALE < scale < MAX_SCALE and offset < MAX_OFFSET_RATIO * recording.rig.size:
        return []
    text = (
        f"The target '{recording.info.target.object_name}' is {scale:.3g} times as large as linear skinning, and its "
        f"center is {format_length(recording.rig, offset)} away: it has another unit or location; scale and move it "
        "onto the mesh, and record again."
    )
    return [RecordingWarning("target-place", text)]


def unsettled_sentence(index: dict) -> str:
    """Describe the poses of a recording that did not come to rest; empty where all did.

    Args:
        index: index of the recording, from `read_index`.
    """
    unsettled = index.get("unsettled", [])
    if not unsettled:
        return ""
    frames = index["target"]["settle_frames"]
    return (
        f"{len(unsettled)} of {index['complete']} poses did not come to rest in {frames} frames: "
        f"{format_list(unsettled)}. A training leaves them out; more frames (--settle-frames) let them rest."
    )
