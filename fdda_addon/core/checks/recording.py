# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks of a recording before training. docs/formats.md has causes and remedies."""

import numpy as np

from ..defaults import MIN_PARTITION_VERTICES
from ..features import float32_rounding, joint_features_in_metres
from ..recording.reader import Recording
from ..rig import STATIC_JOINT_LABEL, Rig
from .flips import check_flips
from .poses import check_poses
from .residual_scan import ResidualScan, scan_residuals
from .rest import check_rest
from .target import check_target
from .warning import RecordingWarning, format_length, format_list, format_with_noun, joint_name

WARNING_NAMES = (
    *("units", "axes", "large-residuals", "duplicate-poses", "hidden-inputs", "degenerate-poses", "flips"),
    *("hysteresis", "frame-jumps", "frozen-frames", "target-place"),
    *("dead-controls", "dead-joints", "still-vertices", "small-partitions"),
)
"""Names of all warnings."""
MIN_MOTION_RATIO = 1e-5
"""Motion over all poses below this ratio of the rig's size counts as none."""
MAX_STILL_RATIO = 0.01
"""Ratio of the vertices that may not move."""
MAX_LISTED_MERGES = 10
"""Largest number of merges that are listed; further ones are counted."""
MIN_CORRELATION = 0.3
"""Correlation above which a joint counts as moved by another joint or by a control."""
MAX_CORRELATED_POSES = 500
"""Largest number of poses over which correlations are computed."""


def check_recording(recording: Recording) -> list[RecordingWarning]:
    """Find mistakes of rig and poses, with bounded memory for recordings of any size.

    Reads residuals of at most `residual_scan.MAX_SCANNED_POSES` poses.

    Returns:
        The warnings in the order of `WARNING_NAMES`; empty for a good recording.
    """
    scan = scan_residuals(recording)
    moving = find_moving_joints(recording)
    warnings = [
        *check_rest(recording.rig),
        *_check_large_residuals(recording, scan),
        *check_poses(recording),
        *check_flips(recording, scan),
        *check_target(recording),
        *_check_controls(recording),
        *_check_joints(recording),
        *_check_still_vertices(recording, scan, moving),
        *_check_small_partitions(recording),
    ]
    return sorted(warnings, key=lambda warning: WARNING_NAMES.index(warning.name))


def merges_sentence(index: dict, min_vertices: int) -> str:
    """Describe the merged partitions: "1 partition of fewer than 8 vertices is merged: …".

    Args:
        index: of the recording.
        min_vertices: the setting of the recording.

    Returns:
        The sentence; empty where none were merged.
    """
    names = [joint["name"] or STATIC_JOINT_LABEL for joint in index["joints"]]
    merges = [f"'{names[j]}' into '{names[p['joint']]}'" for p in index["partitions"] for j in p.get("merged", ())]
    if not merges:
        return ""
    which = "1 partition" if len(merges) == 1 else f"{len(merges)} partitions"
    verb = "is" if len(merges) == 1 else "are"
    more = f" and {len(merges) - MAX_LISTED_MERGES} more" if len(merges) > MAX_LISTED_MERGES else ""
    return (
        f"{which} of fewer than {min_vertices} vertices {verb} merged: {', '.join(merges[:MAX_LISTED_MERGES])}{more}."
    )


def compute_bone_lengths(rig: Rig) -> np.ndarray:
    """Compute bone lengths: the distance to the nearest child, else to the parent, else 0; (J,) float64, mesh units."""
    positions, parents = rig.rest_matrices[:, :3, 3].astype(np.float64), rig.parents
    to_parent = np.where(parents >= 0, np.linalg.norm(positions - positions[parents], axis=1), 0.0)
    nearest = np.full(len(parents), np.inf)
    children = np.flatnonzero(parents >= 0)
    np.minimum.at(nearest, parents[children], to_parent[children])
    return np.where(np.isfinite(nearest), nearest, to_parent)


def find_moving_joints(recording: Recording) -> np.ndarray:
    """Find joints whose pose matrices differ between poses; (J,) bool."""
    low, high = (function(recording.pose_matrices, axis=0) for function in (np.min, np.max))
    rig, moved = recording.rig, high - low
    rounding = float32_rounding(recording.pose_matrices)
    threshold = max(MIN_MOTION_RATIO * max(1 / rig.metres_per_unit, rig.size), rounding)
    return (moved[:, :3, :3].max(axis=(1, 2)) > MIN_MOTION_RATIO) | (moved[:, :3, 3].max(axis=1) > threshold)


def _check_large_residuals(recording: Recording, scan: ResidualScan) -> list[RecordingWarning]:
    """Warn about residuals larger than the bones, because residuals are meant as corrections of skinning."""
    rig, bones = recording.rig, compute_bone_lengths(recording.rig)
    large = []
    for p in recording.partitions:
        extent = float(np.linalg.norm(np.ptp(rig.rest_positions[p.vertices], axis=0)))
        rms = float(np.sqrt(np.mean(scan.rms[p.vertices] ** 2)))
        size = max(float(bones[p.joint]), extent)
        if rms > size > 0:
            large.append((rms / size, rms, size, joint_name(rig, p.joint)))
    advice = (
        "linear skinning is no start there; look at the skin weights and whether mesh and armature match in the rest "
        "pose, or record with --fit-linear smooth."
    )
    if large:
        _, rms, size, name = max(large)
        text = (
            f"Residuals are larger than bones and vertices of {len(large)} of {len(recording.partitions)} partitions, "
            f"most of '{name}', {format_length(rig, rms)} rms where bone and vertices are {format_length(rig, size)} "
            f"long: {advice}"
        )
        return [RecordingWarning("large-residuals", text)]
    vertex = int(scan.largest.argmax())
    size = max(rig.size, float(np.linalg.norm(np.ptp(rig.rest_matrices[:, :3, 3], axis=0))))
    if scan.largest[vertex] <= size:
        return []
    text = (
        f"The residual of vertex {vertex} is {format_length(rig, float(scan.largest[vertex]))} in pose "
        f"{scan.largest_pose[vertex]}, and the character is {format_length(rig, size)} large: {advice}"
    )
    return [RecordingWarning("large-residuals", text)]


def _check_controls(recording: Recording) -> list[RecordingWarning]:
    used = {control for partition in recording.partitions for control in partition.controls}
    controls = recording.rig.controls
    still = {c for c in range(len(controls)) if np.ptp(recording.controls[:, c]) == 0}
    idle = [c for c in range(len(controls)) if c not in used and c not in still]
    poses, features = _sampled_features(recording)
    features = features.reshape(len(poses), -1)
    # A control that moves joints, such as a switch between IK and FK, has an effect.
    idle = [c for c in idle if not _are_related(recording.controls[poses, c : c + 1], features)]
    dead = sorted([*idle, *still])
    if not dead:
        return []
    kept = f", {format_list([controls[c].name for c in dead if c in still])} of them always the same" if still else ""
    text = (
        f"{format_with_noun([controls[c].name for c in dead], 'control')} "
        f"{'changes' if len(dead) == 1 else 'change'} nothing in this recording{kept}: leave "
        f"{'it' if len(dead) == 1 else 'them'} out, or give a wider range, and record again."
    )
    return [RecordingWarning("dead-controls", text[0].upper() + text[1:])]


def _check_joints(recording: Recording) -> list[RecordingWarning]:
    """Warn about sampled joints that change no residual and carry no vertices, themselves or through children."""
    rig = recording.rig
    sampled = {channel.name for channel in recording.info.sampling.channels}
    skinning = np.zeros(len(rig.joints), bool)
    skinning[rig.skin_joints[rig.skin_weights > 0]] = True
    for joint in reversed(range(len(rig.joints))):
        if (parent := rig.joints[joint].parent) >= 0:
            skinning[parent] |= skinning[joint]
    influencing = {joint for partition in recording.partitions for joint in partition.influencing}
    idle = [
        j for j, joint in enumerate(rig.joints) if joint.name in sampled and not skinning[j] and j not in influencing
    ]
    dead = [rig.joints[j].name for j in idle if not _moves_others(recording, j, sampled)]
    if not dead:
        return []
    text = (
        f"{format_with_noun(dead, 'joint')} {'is sampled but moves' if len(dead) == 1 else 'are sampled but move'} no "
        "vertex: lock all axes, or switch Deform off, so that poses are spent on what deforms the mesh."
    )
    return [RecordingWarning("dead-joints", text[0].upper() + text[1:])]


def _moves_others(recording: Recording, joint: int, sampled: set[str]) -> bool:
    """Return whether joints that are not sampled follow this one, through constraints for example."""
    rig = recording.rig
    driven = [j for j, other in enumerate(rig.joints) if other.name not in sampled]
    poses, features = _sampled_features(recording)
    return _are_related(features[:, joint], features[:, driven].reshape(len(poses), -1))


def _sampled_features(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Return (n,) indices of evenly spaced poses and their (n, J, 12) joint features."""
    rig, count = recording.rig, len(recording.pose_matrices)
    poses = np.unique(np.linspace(0, count - 1, MAX_CORRELATED_POSES).round().astype(np.int64))
    return poses, joint_features_in_metres(np.array(recording.pose_matrices[poses]), rig)


def _are_related(first: np.ndarray, second: np.ndarray) -> bool:
    """Return whether any of (n, A) values correlates with any of (n, B) values or their absolute deviations."""
    standard = []
    for values in (first.astype(np.float64), second.astype(np.float64)):
        values = values[:, values.std(axis=0) > MIN_MOTION_RATIO]
        standard.append((values - values.mean(axis=0)) / values.std(axis=0))
    far = np.abs(standard[1])
    far = far - far.mean(axis=0)
    columns = np.concatenate([standard[1], far / np.maximum(far.std(axis=0), MIN_MOTION_RATIO)], axis=1)
    related = np.abs(standard[0].T @ columns) / len(first)
    return bool(related.max(initial=0) > max(MIN_CORRELATION, 5 / np.sqrt(len(first))))


def _check_still_vertices(recording: Recording, scan: ResidualScan, moving: np.ndarray) -> list[RecordingWarning]:
    rig = recording.rig
    carried = ((rig.skin_weights > 0) & moving[rig.skin_joints]).any(axis=1)
    still = ~carried & (scan.change < MIN_MOTION_RATIO * rig.size)
    if still.sum() <= MAX_STILL_RATIO * rig.vertex_count:
        return []
    names = [joint_name(rig, p.joint) for p in recording.partitions if still[p.vertices].any()]
    text = (
        f"{int(still.sum())} of {rig.vertex_count} vertices never move, of {format_with_noun(names, 'partition')}: if "
        "they should, weight them to joints that do, or give their joints a range of motion, and record again."
    )
    return [RecordingWarning("still-vertices", text)]


def _check_small_partitions(recording: Recording) -> list[RecordingWarning]:
    small = [p for p in recording.partitions if len(p.vertices) < MIN_PARTITION_VERTICES]
    if not small or len(recording.partitions) == 1:
        return []
    names = [joint_name(recording.rig, p.joint) for p in small]
    fewest = min(len(p.vertices) for p in small)
    text = (
        f"{format_with_noun(names, 'partition')} {'has' if len(small) == 1 else 'have'} fewer than "
        f"{MIN_PARTITION_VERTICES} vertices (the smallest {fewest}), and a network each: record with "
        f"--min-partition-vertices {MIN_PARTITION_VERTICES} to merge them into others."
    )
    return [RecordingWarning("small-partitions", text[0].upper() + text[1:])]
