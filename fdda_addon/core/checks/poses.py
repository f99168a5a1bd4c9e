# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks for repeated poses, equal poses with different meshes, and poses in which joints collapse."""

import hashlib

import numpy as np

from ..mathematics.skinning import skin_matrices
from ..recording.index import ACTION, MIRRORED, STRIP
from ..recording.skinned import SkinnedRecording
from ..wording import format_with_noun
from .warning import RecordingWarning, format_length

_SOURCE_LABELS = {ACTION: "the action", STRIP: "the strip", MIRRORED: "the mirrored"}
"""Labels of the sources of frames in messages."""
POSE_TOLERANCE = 1e-5
"""Poses are equal when their elements (meters, no unit, or a control's unit) round to the same multiple of this."""
MAX_REPEATED_RATIO = 0.05
"""Largest ratio of repeated poses without a warning; the last frame of a looping action repeats its first frame."""
MAX_COMPARED_PAIRS = 200
"""Largest number of pairs of equal poses that are compared."""
CONTRADICTION_RATIO = 1e-4
"""Equal poses contradict each other where a residual differs by more than this ratio of the rig's size."""
MIN_VOLUME_FACTOR, MAX_VOLUME_FACTOR = 1e-3, 1e3
"""Range of the factor by which a joint may change volumes."""
POSE_BATCH = 100
"""Number of poses that are checked at once."""


def check_poses(recording: SkinnedRecording) -> list[RecordingWarning]:
    """Return the warnings "duplicate-poses", "hidden-inputs" and "degenerate-poses"."""
    pairs = find_repeated_poses(recording)
    return [*_check_repeated(recording, pairs), *_check_contradictions(recording, pairs), *_check_collapsed(recording)]


def find_repeated_poses(recording: SkinnedRecording) -> np.ndarray:
    """Find poses that equal an earlier pose.

    Returns:
        (n, 2) int64 indices: in each row a pose, and the first pose that it equals.
    """
    first_poses: dict[bytes, int] = {}
    pairs = []
    for start in range(0, len(recording.pose_matrices), POSE_BATCH):
        batch = slice(start, start + POSE_BATCH)
        matrices, controls = np.array(recording.pose_matrices[batch], np.float64), recording.controls[batch]
        matrices[..., :3, 3] *= recording.rig.metres_per_unit
        rows = np.concatenate([matrices.reshape(len(matrices), -1), controls], axis=1)
        for pose, row in enumerate(np.round(rows / POSE_TOLERANCE).astype(np.int64), start):
            first_pose = first_poses.setdefault(hashlib.sha256(row.tobytes()).digest(), pose)
            if first_pose != pose:
                pairs.append((pose, first_pose))
    return np.array(pairs, np.int64).reshape(-1, 2)


def _check_repeated(recording: SkinnedRecording, pairs: np.ndarray) -> list[RecordingWarning]:
    count = len(recording.pose_matrices)
    if len(pairs) <= MAX_REPEATED_RATIO * count:
        return []
    text = (
        f"{len(pairs)} of {count} poses repeat an earlier one, such as pose {pairs[0, 0]} pose {pairs[0, 1]}"
        f"{_format_sources(recording, pairs[:, 0])}: they count twice in the training, and make the held-out "
        "error too small; record actions without holds, once each, or more random poses."
    )
    return [RecordingWarning("duplicate-poses", text)]


def _format_sources(recording: SkinnedRecording, poses: np.ndarray) -> str:
    """Describe the actions of poses: ", 30 of them of the action 'idle'"; empty where no pose is from an action."""
    sources = recording.info.sampling.sources
    source_indices = np.searchsorted(np.cumsum([source.poses for source in sources]), poses, side="right")
    counts = np.bincount(source_indices, minlength=len(sources))
    descriptions = [
        f"{count} of them of {_SOURCE_LABELS[source.kind]} '{source.name}'"
        for count, source in zip(counts, sources, strict=True)
        if count and source.kind in _SOURCE_LABELS
    ]
    return "".join(f", {description}" for description in descriptions[:2])


def _check_contradictions(recording: SkinnedRecording, pairs: np.ndarray) -> list[RecordingWarning]:
    tolerance, worst, contradictions = CONTRADICTION_RATIO * recording.rig.size, (0.0, 0, 0), 0
    for pose, first_pose in pairs[:: max(1, len(pairs) // MAX_COMPARED_PAIRS)].tolist():
        difference = np.subtract(*recording.read_positions(np.array([pose, first_pose])))
        max_distance = float(np.sqrt(np.einsum("vc,vc->v", difference, difference).max(initial=0)))
        contradictions += max_distance > tolerance
        worst = max(worst, (max_distance, pose, first_pose))
    if not contradictions:
        return []
    text = (
        f"Poses {worst[2]} and {worst[1]} have the same joints and controls and yet vertices lie up to "
        f"{format_length(recording.rig, worst[0])} apart: something else moves the mesh, a property without a control, "
        "the frame or a simulation; list it as a control, or switch it off, and record again."
    )
    return [RecordingWarning("hidden-inputs", text)]


def _check_collapsed(recording: SkinnedRecording) -> list[RecordingWarning]:
    rig = recording.rig
    skinning_joints = np.unique(
        np.concatenate([rig.skin_joints[rig.skin_weights > 0], [p.joint for p in recording.partitions]])
    )
    collapsed_poses, worst_factors = [], np.ones(len(skinning_joints))
    for start in range(0, len(recording.pose_matrices), POSE_BATCH):
        matrices = np.asarray(recording.pose_matrices[start : start + POSE_BATCH])[:, skinning_joints]
        skin = skin_matrices(matrices, rig.rest_matrices[skinning_joints])
        volume_factors = np.linalg.det(skin[:, :, :3, :3].astype(np.float64))
        is_collapsed = (volume_factors < MIN_VOLUME_FACTOR) | (volume_factors > MAX_VOLUME_FACTOR)
        collapsed_poses += (start + np.flatnonzero(is_collapsed.any(axis=1))).tolist()
        distances_from_1 = np.abs(np.log10(np.maximum(volume_factors, 1e-30)))
        batch_worst_factors = np.take_along_axis(volume_factors, distances_from_1.argmax(axis=0)[None], axis=0)[0]
        worst_factors = np.where(is_collapsed.any(axis=0) & (worst_factors == 1), batch_worst_factors, worst_factors)
    if not collapsed_poses:
        return []
    joints = np.flatnonzero(worst_factors != 1)
    names = [rig.joints[skinning_joints[i]].name for i in joints]
    text = (
        f"{format_with_noun(names, 'joint')} {'has' if len(names) == 1 else 'have'} a scale near zero, huge or "
        f"negative in {format_with_noun(collapsed_poses, 'pose')}, volumes by a factor of "
        f"{worst_factors[joints[0]]:.2g}: look for a constraint or driver that sets it, limit it and record again."
    )
    return [RecordingWarning("degenerate-poses", text)]
