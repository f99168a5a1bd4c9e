# SPDX-License-Identifier: GPL-3.0-or-later
"""Analysis of the largest errors of each partition. The report shows what is likely to lower them."""

from dataclasses import dataclass

import numpy as np

from fdda_addon.core.mathematics.features import FEATURES_PER_JOINT
from fdda_addon.core.mathematics.partition import Partition
from fdda_addon.core.mathematics.refinement import nearest_recorded_distances
from fdda_addon.core.recording.skinned import SkinnedRecording

from ..data.split import Split
from ..fits.half_rotations import regression_matrices
from ..inputs.network_inputs import NetworkInputs
from ..model import TrainedModel
from ..preparation import PreparedPartition

TOO_FEW_COMPONENTS, UNPREDICTED_COMPONENTS, EXTREME_POSES, TOO_FEW_POSES, HIGH_TRAINING_ERRORS, NO_CLEAR_CAUSE = (
    *("components", "unpredicted", "extremes", "poses", "steep", "none"),
)
REMEDY_BY_CAUSE = {
    TOO_FEW_COMPONENTS: "more components: a smaller tolerance",
    UNPREDICTED_COMPONENTS: (
        "more poses, or the missing control: the networks do not predict components, which were dropped"
    ),
    EXTREME_POSES: "more poses at the extremes: refinement, or a larger spread",
    TOO_FEW_POSES: "more poses",
    HIGH_TRAINING_ERRORS: (
        "little: training poses have the same errors, so the rig flips there, or the networks are too small"
    ),
    NO_CLEAR_CAUSE: "no cause stands out",
}
"""For each probable cause of large errors, the change that is likely to lower them."""

ANALYZED_FRACTION = 5e-3
"""Part of a partition's held-out errors that is analyzed. They are the largest errors, and at least one."""
MAX_TRAINING_POSES = 2000
"""Maximum number of training poses among which the nearest pose is searched."""
MIN_TRUNCATION_FRACTION = 0.5
"""Too few components are the cause if they leave at least this part of the squared error."""
MIN_GENERALIZATION_RATIO = 1.5
"""Too few poses are the cause if the held-out errors are at least this many times the training errors."""
MIN_DISTANCE_RATIO = 1.5
"""Poses are extreme if the nearest training pose is at least this many times as far as the median."""
MIN_SPREAD_RATIO = 1e-3
"""Features are ignored if their standard deviation is below this part of the largest one."""


@dataclass(frozen=True)
class ErrorAnalysis:
    """The largest held-out errors of one partition.

    Attributes:
        poses, vertices: numbers of different poses and vertices with these errors.
        truncation: part of the squared errors that the components do not represent.
        joint: name of the influencing joint or control that is furthest from its mean in these poses; empty if nothing
            influences the partition.
        extreme: ratio between the distance of this joint from its mean in these poses and in all held-out poses.
        distance: ratio between the distance of these poses to the nearest training pose and the median distance of all
            held-out poses.
        generalization: ratio between the 99.9th percentiles of the held-out errors and of the training errors.
        cause: key of `REMEDY_BY_CAUSE`.
    """

    poses: int
    vertices: int
    truncation: float
    joint: str
    extreme: float
    distance: float
    generalization: float
    cause: str


def analyze_errors(
    recording: SkinnedRecording,
    trained_model: TrainedModel,
    split: Split,
    held_out_errors: np.ndarray,
    training_errors: np.ndarray,
) -> list[ErrorAnalysis]:
    """Analyze the largest errors of each partition.

    Args:
        held_out_errors: (n, V) float32 errors of the held-out poses, meters.
        training_errors: (m, V) float32 errors of some training poses, meters.
    """
    training = split.training[:: max(1, len(split.training) // MAX_TRAINING_POSES)]
    direct_blocks = [block for block in trained_model.inputs.blocks if block.is_direct]
    inputs = NetworkInputs.of(direct_blocks, trained_model.partitions)
    held_out_features, training_features = (
        inputs.compute_features(*(np.array(array[poses]) for array in (recording.pose_matrices, recording.controls)))
        for poses in (split.held_out, training)
    )
    analyses = []
    for partition, columns in zip(trained_model.partitions, inputs.columns, strict=True):
        errors = held_out_errors[:, partition.vertices].astype(np.float64)
        count = max(1, round(errors.size * ANALYZED_FRACTION))
        largest = np.argpartition(errors.ravel(), -count)[-count:]
        poses, vertices = np.unravel_index(largest, errors.shape)
        held_out_values, training_values = (f.take(columns, axis=1) for f in (held_out_features, training_features))
        nearest_distances = (
            nearest_recorded_distances(held_out_values, training_values)
            if held_out_values.shape[1]
            else np.zeros(len(held_out_values))
        )
        distance = _ratio(float(nearest_distances[poses].mean()), float(np.median(nearest_distances)))
        joint, extreme = _most_extreme_joint(recording, partition, held_out_values, training_values, poses)
        parts = trained_model.parts_of(partition)
        truncation = _truncation_fraction(recording, partition, parts, split.held_out, poses, vertices, errors)
        percentiles = (float(np.percentile(e, 99.9)) for e in (errors, training_errors[:, partition.vertices]))
        generalization = _ratio(*percentiles)
        # Dropped components are the cause only if they are most of what the remaining ones leave.
        dropped = sum(prepared.vertex_count * prepared.dropped_rms**2 for _, prepared in parts)
        truncated = sum(prepared.vertex_count * prepared.basis.truncation_rms**2 for _, prepared in parts)
        is_dropped = 2 * dropped > truncated
        cause = _cause(truncation, is_dropped, distance, generalization)
        counts = len(np.unique(poses)), len(np.unique(vertices))
        analyses.append(ErrorAnalysis(*counts, truncation, joint, extreme, distance, generalization, cause))
    return analyses


def _cause(truncation: float, is_dropped: bool, distance: float, generalization: float) -> str:
    if truncation >= MIN_TRUNCATION_FRACTION:
        return UNPREDICTED_COMPONENTS if is_dropped else TOO_FEW_COMPONENTS
    is_extreme = distance >= MIN_DISTANCE_RATIO
    if generalization >= MIN_GENERALIZATION_RATIO:
        return EXTREME_POSES if is_extreme else TOO_FEW_POSES
    if is_extreme:
        return EXTREME_POSES
    return HIGH_TRAINING_ERRORS if truncation < MIN_TRUNCATION_FRACTION / 2 else NO_CLEAR_CAUSE


def _ratio(value: float, reference: float) -> float:
    return value / reference if reference > 0 else 1.0


def _most_extreme_joint(
    recording: SkinnedRecording,
    partition: Partition,
    held_out_values: np.ndarray,
    training_values: np.ndarray,
    poses: np.ndarray,
) -> tuple[str, float]:
    """Find the joint or control that is furthest from its mean in the analyzed poses.

    Args:
        held_out_values: (n, f) features of the influencing joints and controls in the held-out poses.
        training_values: (m, f) values of training poses.
        poses: indices of the analyzed poses among the n.

    Returns:
        The name, and the ratio between its distance from the mean in the analyzed poses and in all n poses.
    """
    names = [recording.rig.joint_names[joint] for joint in partition.influencing]
    column_counts = [FEATURES_PER_JOINT] * len(names) + [1] * len(partition.controls)
    names += [recording.rig.controls[control].name for control in partition.controls]
    spread = training_values.std(axis=0, dtype=np.float64)
    is_used = spread > spread.max(initial=0) * MIN_SPREAD_RATIO
    squares = np.zeros(held_out_values.shape)
    offsets = (held_out_values - training_values.mean(axis=0, dtype=np.float64))[:, is_used]
    squares[:, is_used] = (offsets / spread[is_used]) ** 2
    most_extreme, squares_by_name = ("", 1.0), np.split(squares, np.cumsum(column_counts), axis=1)
    for name, columns in zip(names, squares_by_name[:-1], strict=True):
        distances = np.sqrt(columns.sum(axis=1))
        distance_ratio = _ratio(float(distances[poses].mean()), float(distances.mean()))
        most_extreme = max(most_extreme, (name, distance_ratio), key=lambda pair: pair[1])
    return most_extreme


def _truncation_fraction(
    recording: SkinnedRecording,
    partition: Partition,
    parts: list[tuple[Partition, PreparedPartition]],
    held_out_poses: np.ndarray,
    poses: np.ndarray,
    vertices: np.ndarray,
    errors: np.ndarray,
) -> float:
    """Return the part of the squared errors that fit and components do not represent.

    Args:
        held_out_poses: indices of the n held-out poses.
        poses, vertices: indices of the analyzed errors.
        errors: (n, Vp) distances, meters.
    """
    unique_poses, rows = np.unique(poses, return_inverse=True)
    pose_indices = held_out_poses[unique_poses]
    remaining_residuals = recording.compute_partition_residuals(partition, pose_indices).astype(np.float64)
    pose_matrices, controls = (np.array(array[pose_indices]) for array in (recording.pose_matrices, recording.controls))
    for part, prepared in parts:
        rows_of_part = np.searchsorted(partition.vertices, part.vertices)
        part_residuals = np.zeros((len(pose_indices), len(part.vertices), 3))
        if len(prepared.fit.joints):
            use_half_rotations = prepared.fit.joints.max() >= len(recording.rig.joints)
            matrices = regression_matrices(pose_matrices, recording.rig, use_half_rotations)
            to_local = np.linalg.inv(matrices[:, prepared.fit.joints[0], :, :3].astype(np.float64))
            part_residuals += prepared.fit.compute_offsets(matrices) @ to_local.transpose(0, 2, 1)
        if len(prepared.fit.controls):
            part_residuals += prepared.fit.compute_key_residuals(controls)
        components = prepared.basis.reconstruct(prepared.coefficients[pose_indices])
        remaining_residuals[:, rows_of_part] -= part_residuals + components.reshape(part_residuals.shape)
    distances = np.linalg.norm(remaining_residuals, axis=2)[rows, vertices] * recording.rig.metres_per_unit
    return min(1.0, _ratio(float((distances**2).sum()), float((errors[poses, vertices] ** 2).sum())))
