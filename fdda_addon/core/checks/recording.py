# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks of a recording before training. docs/formats.md describes the causes of each warning and the remedies."""

import numpy as np

from ..controls import SHAPE_KEY_PATH
from ..mathematics.features import FEATURES_PER_JOINT, joint_features_in_metres
from ..recording.skinned import SkinnedRecording
from ..rig import Rig
from ..wording import format_count, format_list, format_with_noun
from .flips import check_flips
from .poses import check_poses
from .residual_scan import ResidualScan, scan_residuals
from .rest import check_rest
from .seams import check_seams
from .target import check_target
from .warning import RecordingWarning, format_length, joint_name

WARNING_NAMES = (
    *("units", "axes", "large-residuals", "duplicate-poses", "hidden-inputs", "degenerate-poses", "flips"),
    *("open-seams", "hysteresis", "frame-jumps", "frozen-frames", "target-place"),
    *("dead-controls", "dead-joints"),
)
"""Names of all warnings."""
MIN_MOTION_RATIO = 1e-5
"""A vertex or joint whose motion over all poses is below this ratio of the rig's size counts as still."""
MAX_LISTED_MERGES = 10
"""Largest number of merges that a message lists; further merges are only counted."""
MIN_CORRELATION = 0.3
"""Correlation above which a joint counts as moved by another joint or by a control."""
MAX_CORRELATED_POSES = 500
"""Largest number of poses over which correlations are computed."""


def check_recording(recording: SkinnedRecording) -> list[RecordingWarning]:
    """Find mistakes in the rig and the poses of a recording.

    Residuals of at most `residual_scan.MAX_SCANNED_POSES` poses are read, so that the use of memory is limited for
    recordings of any size.

    Returns:
        The warnings in the order of `WARNING_NAMES`; empty for a good recording.
    """
    scan = scan_residuals(recording)
    warnings = [
        *check_rest(recording.rig),
        *_check_large_residuals(recording, scan),
        *check_poses(recording),
        *check_flips(recording, scan),
        *check_seams(recording),
        *check_target(recording),
        *_check_controls(recording),
        *_check_joints(recording),
    ]
    return sorted(warnings, key=lambda warning: WARNING_NAMES.index(warning.name))


def merges_sentence(recording: SkinnedRecording, min_vertices: int) -> str:
    """Describe the merged partitions: "1 partition of fewer than 8 vertices is merged: …"; empty where none are merged.

    Args:
        min_vertices: smallest number of vertices of a partition in the settings of the training.
    """
    names = [joint_name(recording.rig, joint) for joint in range(len(recording.rig.joints))]
    merges = [f"'{names[joint]}' into '{names[p.joint]}'" for p in recording.partitions for joint in p.merged]
    if not merges:
        return ""
    verb = "is" if len(merges) == 1 else "are"
    omitted_text = f" and {len(merges) - MAX_LISTED_MERGES} more" if len(merges) > MAX_LISTED_MERGES else ""
    shown_merges = ", ".join(merges[:MAX_LISTED_MERGES])
    count_text = format_count(len(merges), "partition")
    return f"{count_text} of fewer than {min_vertices} vertices {verb} merged: {shown_merges}{omitted_text}."


def compute_bone_lengths(rig: Rig) -> np.ndarray:
    """Compute the length of each bone: the distance to the nearest child, else to the parent, else 0.

    Returns:
        (J,) float64, mesh units.
    """
    positions, parents = rig.rest_matrices[:, :3, 3].astype(np.float64), rig.parents
    parent_distances = np.where(parents >= 0, np.linalg.norm(positions - positions[parents], axis=1), 0.0)
    child_distances = np.full(len(parents), np.inf)
    children = np.flatnonzero(parents >= 0)
    np.minimum.at(child_distances, parents[children], parent_distances[children])
    return np.where(np.isfinite(child_distances), child_distances, parent_distances)


def _check_large_residuals(recording: SkinnedRecording, scan: ResidualScan) -> list[RecordingWarning]:
    """Warn about residuals that are larger than the bones; residuals should be small corrections of linear skinning."""
    rig, bone_lengths = recording.rig, compute_bone_lengths(recording.rig)
    large_residuals = []
    # The skin weights of some meshes are fitted later.
    largest, is_weighted = scan.largest.copy(), np.ones(rig.vertex_count, bool)
    is_weighted[rig.unweighted_vertices] = False
    largest[~is_weighted] = 0
    for partition in recording.partitions:
        vertices = partition.vertices[is_weighted[partition.vertices]]
        if not len(vertices):
            continue
        extent = float(np.linalg.norm(np.ptp(rig.rest_positions[vertices], axis=0)))
        rms = float(np.sqrt(np.mean(scan.rms[vertices] ** 2)))
        size = max(float(bone_lengths[partition.joint]), extent)
        if rms > size > 0:
            large_residuals.append((rms / size, rms, size, joint_name(rig, partition.joint)))
    advice = (
        "linear skinning is no start there; look at the skin weights and whether mesh and armature match in the rest "
        "pose, or have weights fitted (--base-skinning smooth)."
    )
    if large_residuals:
        _, rms, size, name = max(large_residuals)
        text = (
            f"Residuals are larger than bones and vertices of {len(large_residuals)} of {len(recording.partitions)} "
            f"partitions, most of '{name}', {format_length(rig, rms)} rms where bone and vertices are "
            f"{format_length(rig, size)} long: {advice}"
        )
        return [RecordingWarning("large-residuals", text)]
    vertex = int(largest.argmax())
    size = max(rig.size, float(np.linalg.norm(np.ptp(rig.rest_matrices[:, :3, 3], axis=0))))
    if largest[vertex] <= size:
        return []
    text = (
        f"The residual of vertex {vertex} is {format_length(rig, float(largest[vertex]))} in pose "
        f"{scan.largest_pose[vertex]}, and the character is {format_length(rig, size)} large: {advice}"
    )
    return [RecordingWarning("large-residuals", text)]


def _check_controls(recording: SkinnedRecording) -> list[RecordingWarning]:
    """Warn about shape keys that are not moved, and about other controls that change neither residuals nor joints."""
    influencing = {control for partition in recording.partitions for control in partition.controls}
    controls, values = recording.rig.controls, recording.controls
    constant = {control for control in range(len(controls)) if np.ptp(values[:, control]) == 0}
    constant_keys = sorted(control for control in constant if controls[control].is_shape_key)
    poses, features = _sampled_features(recording)
    # A control that moves joints, such as a switch between IK and FK, has an effect.
    idle = [
        control
        for control in range(len(controls))
        if control not in constant_keys
        and (
            control in constant
            or (control not in influencing and not _are_related(values[poses, control : control + 1], features))
        )
    ]
    warnings = []
    if constant_keys:
        names = [SHAPE_KEY_PATH.fullmatch(controls[control].path)["name"] for control in constant_keys]
        it = "it" if len(names) == 1 else "them"
        text = (
            f"{format_with_noun(names, 'shape key')} {'has' if len(names) == 1 else 'have'} one value in all poses, so "
            f"a model cannot learn {it}: record an action that moves {it}, or bones that drive {it} (--bones-to-pose), "
            f"or mute {it}."
        )
        warnings.append(RecordingWarning("dead-controls", text))
    if idle:
        constant_names = [controls[control].name for control in idle if control in constant]
        constant_text = f", {format_list(constant_names)} of them always the same" if constant_names else ""
        text = (
            f"{format_with_noun([controls[control].name for control in idle], 'control')} "
            f"{'changes' if len(idle) == 1 else 'change'} nothing in this recording{constant_text}: leave "
            f"{'it' if len(idle) == 1 else 'them'} out, or give a wider range, and record again."
        )
        warnings.append(RecordingWarning("dead-controls", text))
    return warnings


def _check_joints(recording: SkinnedRecording) -> list[RecordingWarning]:
    """Warn about sampled joints that change no residual, and neither skin a vertex nor have a descendant that does.

    The channels of a joint may be controls, whose effect is then that of the controls.
    """
    rig = recording.rig
    used_paths = [rig.controls[control].path for partition in recording.partitions for control in partition.controls]
    sampled_names = {channel.name for channel in recording.info.sampling.channels}
    is_used = np.zeros(len(rig.joints), bool)
    is_used[rig.skin_joints[rig.skin_weights > 0]] = True
    for joint in reversed(range(len(rig.joints))):
        if (parent := rig.joints[joint].parent) >= 0:
            is_used[parent] |= is_used[joint]
    is_used[[joint for partition in recording.partitions for joint in partition.influencing]] = True
    others = [index for index, joint in enumerate(rig.joints) if joint.name not in sampled_names]
    features = _sampled_features(recording)[1].reshape(-1, len(rig.joints), FEATURES_PER_JOINT)
    dead_names = []
    for index, joint in enumerate(rig.joints):
        bone_path = 'pose.bones["{}"]'.format(joint.name.replace("\\", "\\\\").replace('"', '\\"'))
        if joint.name not in sampled_names or is_used[index] or any(path.startswith(bone_path) for path in used_paths):
            continue
        # Joints that are not sampled may follow it, through constraints for example.
        if not _are_related(features[:, index], features[:, others].reshape(len(features), -1)):
            dead_names.append(joint.name)
    if not dead_names:
        return []
    text = (
        f"{format_with_noun(dead_names, 'joint')} "
        f"{'is sampled but moves' if len(dead_names) == 1 else 'are sampled but move'} no vertex: lock the axes that "
        "have a range, or leave the bones out, so that poses are spent on what deforms the mesh."
    )
    return [RecordingWarning("dead-joints", text)]


def _sampled_features(recording: SkinnedRecording) -> tuple[np.ndarray, np.ndarray]:
    """Return (n,) indices of evenly spaced poses and their (n, 12 J) joint features."""
    pose_count = len(recording.pose_matrices)
    poses = np.unique(np.linspace(0, pose_count - 1, MAX_CORRELATED_POSES).round().astype(np.int64))
    features = joint_features_in_metres(np.array(recording.pose_matrices[poses]), recording.rig)
    return poses, features.reshape(len(poses), -1)


def _are_related(first: np.ndarray, second: np.ndarray) -> bool:
    """Return whether any of (n, A) values correlates with any of (n, B) values or their absolute deviations."""
    standardized = []
    for values in (first.astype(np.float64), second.astype(np.float64)):
        values = values[:, values.std(axis=0) > MIN_MOTION_RATIO]
        standardized.append((values - values.mean(axis=0)) / values.std(axis=0))
    deviations = np.abs(standardized[1])
    deviations = deviations - deviations.mean(axis=0)
    columns = np.concatenate(
        [standardized[1], deviations / np.maximum(deviations.std(axis=0), MIN_MOTION_RATIO)], axis=1
    )
    correlations = np.abs(standardized[0].T @ columns) / len(first)
    return bool(correlations.max(initial=0) > max(MIN_CORRELATION, 5 / np.sqrt(len(first))))
