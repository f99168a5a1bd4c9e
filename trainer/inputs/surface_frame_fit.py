# SPDX-License-Identifier: GPL-3.0-or-later
"""Selects the vertices whose surface frames are inputs of the networks, and fits the frames to the recording.

The selection does not read the modifiers, because a rig may smooth with any modifier, or with nodes. It removes from
the residuals the part that linear regression on the nearby joints explains. It compares the remainder with the corners
of the skinned surface at increasing amounts of smoothing. For a rig that smooths, one of these amounts explains the
remainder.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fdda_addon.core.mathematics.skinning import skin_matrices
from fdda_addon.core.recording.skinned import SkinnedRecording
from fdda_addon.core.rig import Rig

from ..data.split import Split
from ..fits.joint_fit import MIN_SINGULAR_VALUE_RATIO, joint_regression, solve_ridge
from .smoothed_surface import MAX_JOINT_ENTRIES, NO_SURFACE_FRAMES, SmoothedSurface, SurfaceFrames

MAX_POSES = 400
"""Maximum number of training poses that are evaluated."""
MAX_CANDIDATES_PER_PARTITION, MEAN_CANDIDATES_PER_PARTITION = 8, 3
CORNER_COUNT_QUANTILE, MAX_CORNERS = 0.75, 16
"""A vertex is no candidate if it has more face corners than this quantile of the vertices, or than the maximum,
because all selected vertices are padded to the largest corner count."""
MIN_EXPLAINED_VARIANCE, MIN_BEST_EXPLAINED_VARIANCE = 0.8, 0.95
"""Minimum fractions of the squared residual that surface frames explain, after the joints. The first limit applies to
each selected vertex and to the median candidate, the second to the best candidate. Bulges that follow joint angles
reach 0.94 by chance."""
MAX_PROBED_CANDIDATES = 24
"""Maximum number of candidates that determine the number of smoothing iterations."""
RIDGE_RADIANS = 0.03
"""Ridge of the fit. It suppresses tangents, normals and sums of them that rotate by less than this against the joints.
Their coefficients would be so large that rounding errors matter."""


@dataclass(frozen=True)
class _Candidate:
    """A vertex, and the part of its residual that the joints do not explain.

    Attributes:
        vertex, partition, joint: indices; the joint is the partition's main joint.
        mean_square: mean squared residual that joints and earlier candidates of the partition do not explain, square
            mesh units.
        column_space: (3 n, r) orthonormal basis of the residuals of the partition that the joints explain.
        residual: (3 n,) float64, residual that the joints do not explain, in the space of the main joint, mesh units.
    """

    vertex: int
    partition: int
    joint: int
    mean_square: float
    column_space: np.ndarray
    residual: np.ndarray


def select_surface_frames(recording: SkinnedRecording, split: Split, detail_mm: float) -> SurfaceFrames:
    """Select the vertices of each partition that explain most of its residuals, and fit their surface frames.

    Args:
        recording: recording of the training. A mesh without faces has no surface frames.
        split: split of its poses; only training poses are evaluated.
        detail_mm: as in `TrainingConfig`. Vertices that the joints alone place within the tolerance are no
            candidates.

    Returns:
        The surface frames; `NO_SURFACE_FRAMES` for a rig that does not smooth.
    """
    rig = recording.rig
    if not len(rig.face_starts):
        return NO_SURFACE_FRAMES
    training = split.training[np.unique(np.linspace(0, len(split.training) - 1, MAX_POSES).astype(np.int64))]
    matrices = np.array(recording.pose_matrices[training])
    skin = skin_matrices(matrices, rig.rest_matrices)
    is_usable = _may_be_candidate(rig)
    min_mean_square = (detail_mm / (1000 * rig.metres_per_unit)) ** 2
    candidates: list[_Candidate] = []
    for index, partition in enumerate(recording.partitions):
        regression = joint_regression(rig, partition, skin)
        if regression.is_determined():
            column_space = regression.column_space()
            vertices = partition.vertices[is_usable[partition.vertices]]
            residuals = recording.compute_partition_residuals(partition, training, vertices)
            candidates += _select_candidates(residuals, column_space, vertices, index, partition.joint, min_mean_square)
    to_local = np.linalg.inv(skin[:, :, :3, :3].astype(np.float64))
    candidates.sort(key=lambda candidate: -candidate.mean_square)
    max_count = min(MEAN_CANDIDATES_PER_PARTITION * len(recording.partitions), MAX_JOINT_ENTRIES // len(rig.joints))
    candidates = candidates[:max_count]
    if not candidates:
        return NO_SURFACE_FRAMES
    smoothed_surface = SmoothedSurface(rig)
    iteration_count = _best_iteration_count(smoothed_surface, candidates[:MAX_PROBED_CANDIDATES], matrices, to_local)
    candidates.sort(key=lambda candidate: (candidate.partition, candidate.vertex))
    surface_frames = next(
        frames
        for iterations, frames in smoothed_surface.surface_frames(*_vertices_and_joints(candidates))
        if iterations == iteration_count
    )
    lengths, explained_fractions = _fit_lengths(surface_frames, candidates, matrices, to_local)
    # The condition is not inverted, because a comparison with NaN is False.
    if not (
        explained_fractions.max() >= MIN_BEST_EXPLAINED_VARIANCE
        and np.median(explained_fractions) >= MIN_EXPLAINED_VARIANCE
    ):
        return NO_SURFACE_FRAMES
    return replace(surface_frames, lengths=lengths).subset(explained_fractions >= MIN_EXPLAINED_VARIANCE)


def _may_be_candidate(rig: Rig) -> np.ndarray:
    """Return (V,) bool, the vertices in faces that do not have too many corners."""
    counts = np.bincount(rig.face_vertices, minlength=rig.vertex_count)
    max_count = min(np.quantile(counts[counts > 0], CORNER_COUNT_QUANTILE), MAX_CORNERS)
    return (counts > 0) & (counts <= max_count)


def _remove_projection(column_space: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Subtract from (3 n, m) values their projection on the span of an orthonormal basis (3 n, r)."""
    return values - column_space @ (column_space.T @ values)


def _select_candidates(
    residuals: np.ndarray,
    column_space: np.ndarray,
    vertices: np.ndarray,
    partition: int,
    joint: int,
    min_mean_square: float,
) -> list[_Candidate]:
    """Select candidates of a partition greedily. Each is the vertex that joints and earlier candidates explain worst.

    Args:
        residuals: (n, v, 3) float32 local residuals of the usable vertices, mesh units.
        column_space: (3 n, r) orthonormal basis of the residuals that the joints explain.
        vertices: (v,) indices of the usable vertices.
        partition, joint: indices of the partition and its main joint.
        min_mean_square: mean square below which no further candidate is selected, square mesh units.
    """
    pose_count, candidates = len(residuals), []
    flat = residuals.transpose(0, 2, 1).reshape(3 * pose_count, -1)
    unexplained = _remove_projection(column_space.astype(np.float32), flat)
    remaining = unexplained.reshape(pose_count, -1).copy()
    remaining_by_axis = remaining.reshape(pose_count, 3, -1)
    while len(candidates) < min(MAX_CANDIDATES_PER_PARTITION, len(vertices)):
        mean_squares = np.einsum("nav,nav->v", remaining_by_axis, remaining_by_axis) / pose_count
        worst_vertex = int(mean_squares.argmax())
        if mean_squares[worst_vertex] <= min_mean_square:
            break
        residual = unexplained[:, worst_vertex].astype(np.float64)
        vertex, mean_square = int(vertices[worst_vertex]), float(mean_squares[worst_vertex])
        candidates.append(_Candidate(vertex, partition, joint, mean_square, column_space, residual))
        selected_residual = remaining_by_axis[:, :, worst_vertex].copy()
        gram = selected_residual.T.astype(np.float64) @ selected_residual
        ridge = MIN_SINGULAR_VALUE_RATIO**2 * np.trace(gram)
        solution = solve_ridge(gram, selected_residual.T @ remaining, ridge)
        remaining -= selected_residual @ solution.astype(np.float32)
    return candidates


def _vertices_and_joints(candidates: Sequence[_Candidate]) -> np.ndarray:
    """Return (2, D) int64 vertices and main joints of candidates."""
    return np.array([(candidate.vertex, candidate.joint) for candidate in candidates], np.int64).T


def _best_iteration_count(
    smoothed_surface: SmoothedSurface, candidates: Sequence[_Candidate], matrices: np.ndarray, to_local: np.ndarray
) -> int:
    """Return the number of smoothing iterations at which the corners explain most of the candidates' residuals."""
    squared_residuals = np.array([candidate.residual @ candidate.residual for candidate in candidates])
    explained_by_iterations = {
        iterations: float(
            _fit_lengths(surface_frames, candidates, matrices, to_local)[1]
            @ squared_residuals
            / squared_residuals.sum()
        )
        for iterations, surface_frames in smoothed_surface.surface_frames(*_vertices_and_joints(candidates))
    }
    return max(explained_by_iterations, key=explained_by_iterations.__getitem__)


def _fit_lengths(
    surface_frames: SurfaceFrames, candidates: Sequence[_Candidate], matrices: np.ndarray, to_local: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Fit the lengths of tangents and normals to the candidates' residuals.

    Args:
        surface_frames, candidates: D surface frames, each at the vertex of a candidate.
        matrices: (n, J, 4, 4) pose matrices, mesh-object space, mesh units.
        to_local: (n, J, 3, 3) float64, rotate a vector from mesh-object space to the space of a joint's residuals.

    Returns:
        (3, D, K) lengths, mesh units, and the (D,) explained fractions of the squared residuals.
    """
    vectors = surface_frames.compute_corner_vectors(matrices)
    local_vectors = np.einsum("ndab,nfdkb->dnafk", to_local[:, surface_frames.main_joints], vectors)
    lengths, explained_fractions = np.zeros_like(surface_frames.lengths), np.zeros(len(surface_frames))
    for index, candidate in enumerate(candidates):
        is_used, residual = surface_frames.lengths[:, index] != 0, candidate.residual
        regressors = local_vectors[index][..., is_used].reshape(len(residual), -1)
        regressors = _remove_projection(candidate.column_space, regressors)
        gram, ridge = regressors.T @ regressors, RIDGE_RADIANS**2 * len(matrices)
        lengths[:, index][is_used] = solve_ridge(gram, regressors.T @ residual, ridge)
        error = residual - regressors @ lengths[:, index][is_used]
        explained_fractions[index] = 1 - error @ error / (residual @ residual)
    return lengths, explained_fractions
