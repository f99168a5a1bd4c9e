# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks of poses: repeated poses, poses that contradict each other, poses that collapse joints."""

import hashlib

import numpy as np

from ..recording.index import ACTION, MIRRORED, STRIP
from ..recording.reader import Recording
from ..skinning import skin_matrices
from .warning import RecordingWarning, format_length, format_with_noun

_SOURCE_LABELS = {ACTION: "the action", STRIP: "the strip", MIRRORED: "the mirrored"}
"""Labels of the sources of frames in messages."""
POSE_TOLERANCE = 1e-5
"""Poses are equal when their elements (meters, no unit, or a control's unit) round to the same multiple of this."""
MAX_REPEATED_RATIO = 0.05
"""Ratio of the poses that may repeat others, because the last frame of a loop equals its first."""
MAX_COMPARED_PAIRS = 200
"""Largest number of pairs of equal poses that are compared."""
CONTRADICTION_RATIO = 1e-4
"""Equal poses contradict each other when residuals differ by more than this ratio of the rig's size."""
MIN_VOLUME_FACTOR, MAX_VOLUME_FACTOR = 1e-3, 1e3
"""Range of the factor by which a joint may change volumes."""
POSE_BATCH = 100


def check_poses(recording: Recording) -> list[RecordingWarning]:
    """Return the warnings "duplicate-poses", "hidden-inputs" and "degenerate-poses"."""
    pairs = find_repeated_poses(recording)
    return [*_check_repeated(recording, pairs), *_check_contradictions(recording, pairs), *_check_collapsed(recording)]


def find_repeated_poses(recording: Recording) -> np.ndarray:
    """Find poses that equal an earlier pose; returns (n, 2) int64, each pose with the earlier one."""
    first: dict[bytes, int] = {}
    pairs = []
    for start in range(0, len(recording.pose_matrices), POSE_BATCH):
        part = slice(start, start + POSE_BATCH)
        matrices, controls = np.array(recording.pose_matrices[part], np.float64), recording.controls[part]
        matrices[..., :3, 3] *= recording.rig.metres_per_unit
        rows = np.concatenate([matrices.reshape(len(matrices), -1), controls], axis=1)
        for pose, row in enumerate(np.round(rows / POSE_TOLERANCE).astype(np.int64), start):
            earlier = first.setdefault(hashlib.sha256(row.tobytes()).digest(), pose)
            if earlier != pose:
                pairs.append((pose, earlier))
    return np.array(pairs, np.int64).reshape(-1, 2)


def _check_repeated(recording: Recording, pairs: np.ndarray) -> list[RecordingWarning]:
    count = len(recording.pose_matrices)
    if len(pairs) <= MAX_REPEATED_RATIO * count:
        return []
    text = (
        f"{len(pairs)} of {count} poses repeat an earlier one, such as pose {pairs[0, 0]} pose {pairs[0, 1]}"
        f"{_sources(recording, pairs[:, 0])}: they count twice in the training, and make the held-out error too good; "
        "record actions without holds, once each, or more random poses."
    )
    return [RecordingWarning("duplicate-poses", text)]


def _sources(recording: Recording, poses: np.ndarray) -> str:
    """Describe the actions that poses come from: ", 30 of them of the action 'idle'"; empty where there are none."""
    sources = recording.info.sampling.sources
    of_pose = np.searchsorted(np.cumsum([source.poses for source in sources]), poses, side="right")
    counts = np.bincount(of_pose, minlength=len(sources))
    parts = [
        f"{count} of them of {_SOURCE_LABELS[source.kind]} '{source.name}'"
        for count, source in zip(counts, sources, strict=True)
        if count and source.kind in _SOURCE_LABELS
    ]
    return "".join(f", {part}" for part in parts[:2])


def _check_contradictions(recording: Recording, pairs: np.ndarray) -> list[RecordingWarning]:
    tolerance, worst, contradictions = CONTRADICTION_RATIO * recording.rig.size, (0.0, 0, 0), 0
    for pose, earlier in pairs[:: max(1, len(pairs) // MAX_COMPARED_PAIRS)].tolist():
        difference = np.asarray(recording.residuals[pose]) - recording.residuals[earlier]
        farthest = float(np.sqrt(np.einsum("vc,vc->v", difference, difference).max(initial=0)))
        contradictions += farthest > tolerance
        worst = max(worst, (farthest, pose, earlier))
    if not contradictions:
        return []
    text = (
        f"Poses {worst[2]} and {worst[1]} have the same joints and controls and yet vertices lie up to "
        f"{format_length(recording.rig, worst[0])} apart: something else moves the mesh, a property without a control, "
        "the frame or a simulation; list it as a control, or switch it off, and record again."
    )
    return [RecordingWarning("hidden-inputs", text)]


def _check_collapsed(recording: Recording) -> list[RecordingWarning]:
    rig = recording.rig
    used = np.unique(np.concatenate([rig.skin_joints[rig.skin_weights > 0], [p.joint for p in recording.partitions]]))
    collapsed_poses, worst = [], np.ones(len(used))
    for start in range(0, len(recording.pose_matrices), POSE_BATCH):
        matrices = np.asarray(recording.pose_matrices[start : start + POSE_BATCH])[:, used]
        skin = skin_matrices(matrices, rig.rest_matrices[used])
        volumes = np.linalg.det(skin[:, :, :3, :3].astype(np.float64))
        is_collapsed = (volumes < MIN_VOLUME_FACTOR) | (volumes > MAX_VOLUME_FACTOR)
        collapsed_poses += (start + np.flatnonzero(is_collapsed.any(axis=1))).tolist()
        distance = np.abs(np.log10(np.maximum(volumes, 1e-30)))
        worst_volumes = np.take_along_axis(volumes, distance.argmax(axis=0)[None], axis=0)[0]
        worst = np.where(is_collapsed.any(axis=0) & (worst == 1), worst_volumes, worst)
    if not collapsed_poses:
        return []
    joints = np.flatnonzero(worst != 1)
    names = [rig.joints[used[i]].name for i in joints]
    text = (
        f"{format_with_noun(names, 'joint')} {'has' if len(names) == 1 else 'have'} a scale near zero, huge or "
        f"negative in {format_with_noun(collapsed_poses, 'pose')}, volumes by a factor of {worst[joints[0]]:.2g}: look "
        "for a constraint or driver that sets it, limit it and record again."
    )
    return [RecordingWarning("degenerate-poses", text[0].upper() + text[1:])]
