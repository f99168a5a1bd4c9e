# SPDX-License-Identifier: GPL-3.0-or-later
"""Training data of the networks: features and coefficients of each partition."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fdda_addon.core.mathematics.blocks import block_slices
from fdda_addon.core.mathematics.features import MIN_FEATURE_SPREAD, float32_rounding
from fdda_addon.core.mathematics.partition import Partition
from fdda_addon.core.recording.skinned import SkinnedRecording
from fdda_addon.core.rig import Rig
from fdda_addon.core.settings import MAX_DETAIL_MM

from .config import TrainingConfig
from .data.split import Split
from .fits.basis import FINE_TOLERANCE_FACTOR, Basis, allocate_components, make_basis
from .fits.half_rotations import regression_matrices
from .fits.joint_fit import JointFit, JointRegression, joint_regression
from .fits.parts import divide_by_mesh, divide_partition, mesh_of
from .inputs.network_inputs import NetworkInputs

DETAIL_RATIO = 0.01
"""A detail that is chosen automatically, as a part of the rms error of linear skinning."""
MIN_DETAIL_MM = 0.005
"""The smallest detail that is chosen automatically."""
MAX_DETAIL_POSES = 100
"""Maximum number of training poses that determine the detail."""
MIN_DIVIDED_VERTICES = 500
"""Partitions with fewer vertices are not divided."""


@dataclass(frozen=True)
class PartitionData:
    """Features and residuals of one partition, from a recording or another source.

    Attributes:
        features: (N, F) float32, the features that are offered to the network; F may be 0.
        read_residuals: returns the (N, Vp, 3) float32 local residuals, mesh units. It is called once, so that only one
            partition's residuals are in memory at a time.
        read_regression: returns the linear regression that is fitted first; called at most twice. None without joints.
        min_spread: (F,) float64, minimum standard deviation of a feature that varies, or one value for all features.
        columns: (F,) int64, indices of the features among all features of `NetworkInputs`; None for 0 to F - 1.
        mesh: index of the mesh that has its vertices.
    """

    features: np.ndarray
    read_residuals: Callable[[], np.ndarray]
    read_regression: Callable[[], JointRegression] | None = None
    min_spread: np.ndarray | float = MIN_FEATURE_SPREAD
    columns: np.ndarray | None = None
    mesh: int = 0


@dataclass(frozen=True)
class PreparedPartition:
    """A partition that is ready to train.

    Attributes:
        vertex_count: Vp.
        columns: (F',) int64, the offered features that vary over the training poses, the inputs of the network: indices
            among all features of `NetworkInputs`.
        feature_mean, feature_scale: (F',) float32, mean and standard deviation over the training poses.
        inputs: (N, F') float32, standardized features of all poses.
        fit: linear part of the residuals.
        basis: components of the training residuals that remain after the fit.
        coefficients: (N, K) float32, coefficients of all poses, mesh units.
        residual_rms: rms distance from the mean over training poses and vertices, after the fit, mesh units.
        validation: (n,) indices of the validation poses.
        validation_residuals: (n, 3 Vp) float32, their residuals after the fit, mesh units.
        mm_per_unit: millimeters per mesh unit.
        vertex_factors: (r, Vp) float32, right factor of fit and basis (`low_rank`); None where they are not factorized.
        dropped_count: number of components that were dropped after the training (`compression`).
        dropped_rms: rms distance over training poses and vertices that they represent, mesh units.
        mesh: index of the mesh that has its vertices.
    """

    vertex_count: int
    columns: np.ndarray
    feature_mean: np.ndarray
    feature_scale: np.ndarray
    inputs: np.ndarray
    fit: JointFit
    basis: Basis
    coefficients: np.ndarray
    residual_rms: float
    validation: np.ndarray
    validation_residuals: np.ndarray
    mm_per_unit: float = 1000.0
    vertex_factors: np.ndarray | None = None
    dropped_count: int = 0
    dropped_rms: float = 0.0
    mesh: int = 0

    @property
    def validation_truncation(self) -> np.ndarray:
        """(n,) rms distance over the vertices between validation residuals and their approximation, mesh units."""
        truncated = self.validation_residuals - self.basis.reconstruct(self.coefficients[self.validation])
        return np.sqrt((truncated**2).sum(axis=1) / self.vertex_count)


def choose_details(recording: SkinnedRecording, split: Split) -> np.ndarray:
    """Choose the detail of each mesh, mm, by the rms error of linear skinning on the training poses.

    A face moves by millimeters where a body moves by centimeters, so its details are smaller.

    Returns:
        (M,) float64.
    """
    step, slices = -(-len(split.training) // MAX_DETAIL_POSES), recording.rig.mesh_slices
    squares = [
        [np.einsum("vc,vc->v", r[part], r[part], dtype=np.float64).mean() for part in slices]
        for r in recording.iterate_residuals(split.training[::step])
    ]
    rms = np.sqrt(np.average(squares, axis=0, weights=split.weights()[::step]))
    details = np.maximum(float32_rounding(recording.pose_matrices), DETAIL_RATIO * rms)
    return np.clip(1000 * recording.rig.metres_per_unit * details, MIN_DETAIL_MM, MAX_DETAIL_MM)


def make_parts(
    recording: SkinnedRecording, split: Split, tolerances: Sequence[float], min_vertices: int
) -> list[Partition]:
    """Divide the partitions of a recording into parts, by mesh and by the shape keys that they need.

    A part is a partition with fewer vertices: it has its own fit, components and network. The parts of a partition
    have the same main joint and the same confidence. Their controls include the shape keys of adjacent partitions,
    because smoothing carries these across the border.

    Args:
        tolerances: the detail of each mesh, mesh units.
        min_vertices: where a mesh has fewer vertices in a partition, they stay with those of another mesh.
    """
    rig = recording.rig
    matrices = regression_matrices(recording.pose_matrices, rig, use_half_rotations=False)
    parts = []
    for partition in _with_adjacent_keys(rig, divide_by_mesh(rig, recording.partitions, min_vertices)):
        groups = [np.arange(len(partition.vertices))]
        if len(partition.vertices) >= MIN_DIVIDED_VERTICES and _shape_keys(rig, partition):
            regression = joint_regression(rig, partition, matrices, recording.controls)
            residuals, tolerance = recording.compute_partition_residuals(partition), tolerances[mesh_of(rig, partition)]
            fit, _ = regression.fit(residuals, split.training, tolerance / FINE_TOLERANCE_FACTOR)
            values = regression.control_values[split.training][:, np.searchsorted(regression.controls, fit.controls)]
            groups = divide_partition(fit, values.std(axis=0), tolerance)
        parts += [replace(partition, vertices=partition.vertices[group]) for group in groups]
    return parts


def _shape_keys(rig: Rig, partition: Partition) -> set[int]:
    """Return the shape keys of a partition, as indices of controls."""
    return {control for control in partition.controls if rig.controls[control].is_shape_key}


def _with_adjacent_keys(rig: Rig, partitions: Sequence[Partition]) -> list[Partition]:
    """Return partitions with the shape keys of the partitions with which they share an edge."""
    keys = [_shape_keys(rig, partition) for partition in partitions]
    if not any(keys):
        return list(partitions)
    owner = np.empty(rig.vertex_count, np.int64)
    for index, partition in enumerate(partitions):
        owner[partition.vertices] = index
    owners, controls = owner[rig.face_vertices], [set(partition.controls) for partition in partitions]
    is_last_corner = np.isin(np.arange(1, len(owners)), rig.face_starts)
    pairs = np.stack([owners[:-1], owners[1:]], axis=1)[~is_last_corner]
    for first, second in np.unique(pairs, axis=0).tolist():
        controls[first] |= keys[second]
        controls[second] |= keys[first]
    return [replace(p, controls=tuple(sorted(c))) for p, c in zip(partitions, controls, strict=True)]


def partition_data(
    recording: SkinnedRecording,
    inputs: NetworkInputs,
    use_half_rotations: bool = False,
    parts: Sequence[Partition] | None = None,
) -> list[PartitionData]:
    """Create the data of the parts of a recording's partitions, by default whole partitions.

    Args:
        inputs: inputs that were made for these parts.
        use_half_rotations: as in `regression_matrices`.
    """
    rig = recording.rig
    features = inputs.compute_features(recording.pose_matrices, recording.controls)
    matrices = regression_matrices(recording.pose_matrices, rig, use_half_rotations)
    min_length_spread = max(MIN_FEATURE_SPREAD * rig.size, float32_rounding(recording.pose_matrices))
    min_spread = np.where(inputs.length_mask(), min_length_spread, MIN_FEATURE_SPREAD)
    return [
        PartitionData(
            features[:, columns],
            lambda partition=partition: recording.compute_partition_residuals(partition),
            lambda partition=partition: joint_regression(rig, partition, matrices, recording.controls),
            min_spread[columns],
            columns,
            mesh_of(rig, partition),
        )
        for partition, columns in zip(parts or recording.partitions, inputs.columns, strict=True)
    ]


def prepare_partition(
    partition: PartitionData, split: Split, detail_mm: float, seed: int, metres_per_unit: float = 1.0
) -> PreparedPartition:
    """Standardize the features of a partition, fit its linear part, and convert the remainder to coefficients.

    Only training poses determine the statistics, the fit and the basis. A partition without varying features has no
    components, because its mean is its best approximation.

    Args:
        detail_mm: rms error that the components may leave, mm.
        seed: seed of the sample of poses from which the basis is computed.
        metres_per_unit: as in `Rig`.
    """
    features = partition.features
    training = features[split.training].astype(np.float64)
    scale = training.std(axis=0)
    is_varying = scale > partition.min_spread
    columns = np.flatnonzero(is_varying) if partition.columns is None else partition.columns[is_varying]
    mean, scale = training[:, is_varying].mean(axis=0).astype(np.float32), scale[is_varying].astype(np.float32)
    mm_per_unit = 1000 * metres_per_unit
    tolerance = detail_mm / mm_per_unit
    residuals = np.asarray(partition.read_residuals(), np.float32)
    vertex_count = residuals.shape[1]
    fit = JointFit(np.zeros(0, np.int64), np.zeros((0, vertex_count), np.float32))
    if partition.read_regression:
        regression = partition.read_regression()
        regression = regression if len(columns) else regression.main_joint_only()
        fit, residuals = regression.fit(residuals, split.training, tolerance)
    residuals = residuals.reshape(len(features), -1)
    rng, weights = np.random.default_rng([seed, 2]), split.weights()
    basis = make_basis(residuals[split.training], tolerance if len(columns) else np.inf, rng, weights)
    return PreparedPartition(
        vertex_count,
        columns,
        mean,
        scale,
        (features[:, is_varying] - mean) / scale,
        fit,
        basis,
        basis.project(residuals),
        float(np.sqrt(_mean_square(residuals, basis.mean, split.training) / vertex_count)),
        split.validation,
        residuals[split.validation],
        mm_per_unit,
        mesh=partition.mesh,
    )


def prepare_partitions(
    partitions: Sequence[PartitionData],
    split: Split,
    details_mm: Sequence[float],
    config: TrainingConfig,
    metres_per_unit: float = 1.0,
    on_progress: Callable[[int], None] = lambda done: None,
) -> list[PreparedPartition]:
    """Prepare partitions; those of a mesh share one tolerance (`allocate_components`).

    Args:
        details_mm: rms error that the components of each mesh may leave, mm.
        metres_per_unit: as in `Rig`.
        on_progress: called after each partition with the number of partitions that are prepared.
    """
    prepared, counts = [], np.zeros(len(partitions), np.int64)
    for partition in partitions:
        fine_tolerance_mm = details_mm[partition.mesh] / FINE_TOLERANCE_FACTOR
        prepared.append(prepare_partition(partition, split, fine_tolerance_mm, config.seed, metres_per_unit))
        on_progress(len(prepared))
    for mesh, detail_mm in enumerate(details_mm):
        indices = [index for index, partition in enumerate(prepared) if partition.mesh == mesh]
        errors = [prepared[index].basis.error_by_count for index in indices]
        vertex_counts = [prepared[index].vertex_count for index in indices]
        tolerance = detail_mm / (1000 * metres_per_unit)
        counts[indices] = allocate_components(errors, vertex_counts, tolerance, config.hidden[-1] + 1)
    return [
        replace(p, basis=p.basis.truncate(count), coefficients=np.ascontiguousarray(p.coefficients[:, :count]))
        for p, count in zip(prepared, counts, strict=True)
    ]


def _mean_square(residuals: np.ndarray, mean: np.ndarray, poses: np.ndarray) -> float:
    """Return the mean over poses of the squared distance between (N, W) residuals and their mean (W,)."""
    total = 0.0
    for block in block_slices(len(poses), residuals.shape[1]):
        errors = residuals[poses[block]].astype(np.float64) - mean
        total += float(np.einsum("nw,nw->", errors, errors))
    return total / len(poses)
