# SPDX-License-Identifier: GPL-3.0-or-later
"""What is suspicious about a recording, before a training is spent on it. docs/formats.md has causes and remedies."""

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
from .warning import RecordingWarning, counted, joint_name, length, listed

NAMES = (
    *("units", "axes", "large-residuals", "duplicate-poses", "hidden-inputs", "degenerate-poses", "flips"),
    *("hysteresis", "frame-jumps", "frozen-frames", "target-place"),
    *("dead-controls", "dead-joints", "still-vertices", "small-partitions"),
)
"""All names that a warning may have."""
STILL = 1e-5
"""What moves by less than this part of the character's size, in all poses, counts as still."""
MAX_STILL = 0.01
"""Part of the vertices that may be still."""
MAX_MERGES = 10
"""Merges beyond this many are counted, not listed."""
RELATED = 0.3
"""Correlation from which on a joint counts as moved by another, or by a control."""
MAX_RELATED = 500
"""The correlation is measured over at most this number of poses."""


def check_recording(recording: Recording) -> list[RecordingWarning]:
    """Look for mistakes of rig and poses; memory stays bounded however large the recording is.

    Residuals are read of at most `residual_scan.MAX_POSES` poses.

    Returns:
        The warnings, in the order of `NAMES`; none for a good recording.
    """
    scan = scan_residuals(recording)
    moving = moving_joints(recording)
    found = [
        *check_rest(recording.rig),
        *_check_large(recording, scan),
        *check_poses(recording),
        *check_flips(recording, scan),
        *check_target(recording),
        *_check_controls(recording),
        *_check_joints(recording),
        *_check_still(recording, scan, moving),
        *_check_small(recording),
    ]
    return sorted(found, key=lambda warning: NAMES.index(warning.name))


def merges_in_words(index: dict, least: int) -> str:
    """A line about the small partitions that were merged: "1 partition of fewer than 8 vertices is merged: …".

    Args:
        index: of the recording.
        least: how many vertices a partition was to have.

    Returns:
        The line, empty when none were merged.
    """
    names = [joint["name"] or STATIC_JOINT_LABEL for joint in index["joints"]]
    merges = [f"'{names[j]}' into '{names[p['joint']]}'" for p in index["partitions"] for j in p.get("merged", ())]
    if not merges:
        return ""
    which = "1 partition" if len(merges) == 1 else f"{len(merges)} partitions"
    verb = "is" if len(merges) == 1 else "are"
    more = f" and {len(merges) - MAX_MERGES} more" if len(merges) > MAX_MERGES else ""
    return f"{which} of fewer than {least} vertices {verb} merged: {', '.join(merges[:MAX_MERGES])}{more}."


def bone_lengths(rig: Rig) -> np.ndarray:
    """(J,) float64, from each joint to its nearest child, else to its parent, 0 for one that is alone; metres."""
    places, parents = rig.rest_matrices[:, :3, 3].astype(np.float64), rig.parents
    to_parent = np.where(parents >= 0, np.linalg.norm(places - places[parents], axis=1), 0.0)
    nearest = np.full(len(parents), np.inf)
    children = np.flatnonzero(parents >= 0)
    np.minimum.at(nearest, parents[children], to_parent[children])
    return np.where(np.isfinite(nearest), nearest, to_parent)


def moving_joints(recording: Recording) -> np.ndarray:
    """(J,) bool, the joints whose pose matrices are not the same in all poses."""
    low, high = (function(recording.pose_matrices, axis=0) for function in (np.min, np.max))
    rig, moved = recording.rig, high - low
    least = max(STILL * max(1 / rig.metres_per_unit, rig.size), float32_rounding(recording.pose_matrices))
    return (moved[:, :3, :3].max(axis=(1, 2)) > STILL) | (moved[:, :3, 3].max(axis=1) > least)


def _check_large(recording: Recording, scan: ResidualScan) -> list[RecordingWarning]:
    """Residuals are to be corrections of skinning: smaller than what they correct."""
    rig, bones = recording.rig, bone_lengths(recording.rig)
    large = []
    for p in recording.partitions:
        extent = float(np.linalg.norm(np.ptp(rig.rest_positions[p.vertices], axis=0)))
        rms = float(np.sqrt(np.mean(scan.rms[p.vertices] ** 2)))
        own = max(float(bones[p.joint]), extent)
        if rms > own > 0:
            large.append((rms / own, rms, own, joint_name(rig, p.joint)))
    advice = (
        "linear skinning is no start there; look at the skin weights and whether mesh and armature match in the rest "
        "pose, or record with --fit-linear smooth."
    )
    if large:
        _, rms, own, name = max(large)
        text = (
            f"Residuals are larger than bones and vertices of {len(large)} of {len(recording.partitions)} partitions, "
            f"most of '{name}', {length(rig, rms)} rms where bone and vertices are {length(rig, own)} long: {advice}"
        )
        return [RecordingWarning("large-residuals", text)]
    vertex = int(scan.largest.argmax())
    size = max(rig.size, float(np.linalg.norm(np.ptp(rig.rest_matrices[:, :3, 3], axis=0))))
    if scan.largest[vertex] <= size:
        return []
    text = (
        f"The residual of vertex {vertex} is {length(rig, float(scan.largest[vertex]))} in pose "
        f"{scan.largest_pose[vertex]}, and the character is {length(rig, size)} large: {advice}"
    )
    return [RecordingWarning("large-residuals", text)]


def _check_controls(recording: Recording) -> list[RecordingWarning]:
    used = {control for partition in recording.partitions for control in partition.controls}
    controls = recording.rig.controls
    still = {c for c in range(len(controls)) if np.ptp(recording.controls[:, c]) == 0}
    idle = [c for c in range(len(controls)) if c not in used and c not in still]
    poses, features = _sampled_features(recording)
    features = features.reshape(len(poses), -1)
    # One that moves joints, as a switch between IK and FK, has done its part.
    idle = [c for c in idle if not _are_related(recording.controls[poses, c : c + 1], features)]
    dead = sorted([*idle, *still])
    if not dead:
        return []
    kept = f", {listed([controls[c].name for c in dead if c in still])} of them always the same" if still else ""
    text = (
        f"{counted([controls[c].name for c in dead], 'control')} "
        f"{'changes' if len(dead) == 1 else 'change'} nothing in this recording{kept}: leave "
        f"{'it' if len(dead) == 1 else 'them'} out, or give a wider range, and record again."
    )
    return [RecordingWarning("dead-controls", text[0].upper() + text[1:])]


def _check_joints(recording: Recording) -> list[RecordingWarning]:
    """Joints that are sampled, move no residual, and carry no vertex and no joint with vertices."""
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
        f"{counted(dead, 'joint')} {'is sampled but moves' if len(dead) == 1 else 'are sampled but move'} no vertex: "
        "lock all axes, or switch Deform off, so that poses are spent on what deforms the mesh."
    )
    return [RecordingWarning("dead-joints", text[0].upper() + text[1:])]


def _moves_others(recording: Recording, joint: int, sampled: set[str]) -> bool:
    """Whether joints that are not sampled themselves move with this one: through constraints, not as its children."""
    rig = recording.rig
    driven = [j for j, other in enumerate(rig.joints) if other.name not in sampled]
    poses, features = _sampled_features(recording)
    return _are_related(features[:, joint], features[:, driven].reshape(len(poses), -1))


def _sampled_features(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """(n,) indices of evenly spaced poses, and their (n, J, 12) joint features."""
    rig, count = recording.rig, len(recording.pose_matrices)
    poses = np.unique(np.linspace(0, count - 1, MAX_RELATED).round().astype(np.int64))
    return poses, joint_features_in_metres(np.array(recording.pose_matrices[poses]), rig)


def _are_related(first: np.ndarray, second: np.ndarray) -> bool:
    """Whether any of the (n, A) values goes along with any of the (n, B) values or with how far it is from its mean."""
    standard = []
    for values in (first.astype(np.float64), second.astype(np.float64)):
        values = values[:, values.std(axis=0) > STILL]
        standard.append((values - values.mean(axis=0)) / values.std(axis=0))
    far = np.abs(standard[1])
    far = far - far.mean(axis=0)
    columns = np.concatenate([standard[1], far / np.maximum(far.std(axis=0), STILL)], axis=1)
    related = np.abs(standard[0].T @ columns) / len(first)
    return bool(related.max(initial=0) > max(RELATED, 5 / np.sqrt(len(first))))


def _check_still(recording: Recording, scan: ResidualScan, moving: np.ndarray) -> list[RecordingWarning]:
    rig = recording.rig
    carried = ((rig.skin_weights > 0) & moving[rig.skin_joints]).any(axis=1)
    still = ~carried & (scan.change < STILL * rig.size)
    if still.sum() <= MAX_STILL * rig.vertex_count:
        return []
    names = [joint_name(rig, p.joint) for p in recording.partitions if still[p.vertices].any()]
    text = (
        f"{int(still.sum())} of {rig.vertex_count} vertices never move, of {counted(names, 'partition')}: if they "
        "should, weight them to joints that do, or give their joints a range of motion, and record again."
    )
    return [RecordingWarning("still-vertices", text)]


def _check_small(recording: Recording) -> list[RecordingWarning]:
    small = [p for p in recording.partitions if len(p.vertices) < MIN_PARTITION_VERTICES]
    if not small or len(recording.partitions) == 1:
        return []
    names = [joint_name(recording.rig, p.joint) for p in small]
    fewest = min(len(p.vertices) for p in small)
    text = (
        f"{counted(names, 'partition')} {'has' if len(small) == 1 else 'have'} fewer than {MIN_PARTITION_VERTICES} "
        f"vertices (the smallest {fewest}), and a network each: record with --min-partition-vertices "
        f"{MIN_PARTITION_VERTICES} to merge them into others."
    )
    return [RecordingWarning("small-partitions", text[0].upper() + text[1:])]
