# SPDX-License-Identifier: GPL-3.0-or-later
"""Selects the vertices whose surface frames are inputs of the networks, and fits the frames to the recording.

The selection does not read the modifiers, because a rig may smooth with any modifier, or with nodes. It removes from
the residuals the part that linear regression on the nearby joints explains. It compares the remainder with the corners
of the skinned surface at increasing amounts of smoothing. For a rig that smooths, one of these amounts explains the
remainder.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from fdda_addon.core.recording.reader import Recording
from fdda_addon.core.rig import Rig
from fdda_addon.core.skinning import skin_matrices
from fdda_addon.core.surface import adjacent_corners

from .joint_fit import MIN_SINGULAR_VALUE_RATIO, joint_regression
from .process import Cancelled
from .splitting import Split
from .surface_frames import MAX_JOINT_ENTRIES, NO_SURFACE_FRAMES, SurfaceFrameFeatures

MAX_POSES = 400
"""Maximum number of training poses that are evaluated."""
MAX_PER_PARTITION, MEAN_PER_PARTITION = 8, 3
CORNER_COUNT_QUANTILE, MAX_CORNERS = 0.75, 16
"""A vertex is no candidate where it has more face corners than this quantile of the vertices, or than the maximum: all
selected vertices are padded to the largest corner count."""
SMOOTHING_ITERATIONS = (2, 3, 4, 5, 6, 8, 10, 12, 14, 16, 20, 24, 28, 32, 40, 48, 56, 64)
SMOOTHING_FACTOR = 0.5
"""Factor of each smoothing iteration. One iteration at twice the factor smooths about as much as two iterations."""
MIN_EXPLAINED_VARIANCE, MIN_BEST_EXPLAINED_VARIANCE = 0.8, 0.95
"""Explained part of the squared residual that the joints leave: minimum of a selected vertex and of the median
candidate, and minimum of the best candidate. Bulges that follow joint angles reach 0.94 by chance."""
EPSILON_RATIO = 0.01
"""`SurfaceFrameFeatures.epsilons` over the corner's longer tangent in the rest pose, for the normal over its square. A
vector whose direction is mostly rounding fades out."""
MAX_PROBED_CANDIDATES = 24
"""Maximum number of candidates that determine the number of smoothing iterations."""
MIN_EXTENT = 1e-18
"""Minimum epsilon, for corners without extent; mesh units."""
RIDGE_RADIANS = 0.03
"""Ridge of the fit: tangents and normals, and sums of them, that rotate by less than this against the joints are
suppressed. Their coefficients would be so large that rounding matters."""


@dataclass(frozen=True)
class _Candidate:
    """A vertex, and the part of its residual that the joints do not explain.

    Attributes:
        vertex, partition, joint: indices; the joint is the partition's main joint.
        score: mean squared residual that joints and earlier candidates of the partition leave, square mesh units.
        residual: (3 n,) float64, what the joints leave, in the space of the main joint, mesh units.
    """

    vertex: int
    partition: int
    joint: int
    score: float
    residual: np.ndarray


@dataclass(frozen=True)
class _Corners:
    """The face corners of each vertex.

    Attributes:
        starts: (V + 1,) offsets of each vertex's corners.
        before, after: (C,) preceding and following vertex of each corner in its face.
    """

    starts: np.ndarray
    before: np.ndarray
    after: np.ndarray


@dataclass(frozen=True)
class _Poses:
    """The n evaluated poses.

    Attributes:
        matrices: (n, J, 4, 4) pose matrices, mesh-object space, mesh units.
        to_local: (n, J, 3, 3) float64, rotate a vector from mesh-object space to the space of a joint's residuals.
        column_spaces: by partition index (3 n, r), orthonormal basis of what the nearby joints explain.
    """

    matrices: np.ndarray
    to_local: np.ndarray
    column_spaces: dict[int, np.ndarray]


def select_surface_frames(
    recording: Recording, split: Split, tolerance_mm: float, should_stop: Callable[[], bool] = lambda: False
) -> SurfaceFrameFeatures:
    """Select the vertices of each partition that explain most of its residuals, and fit their surface frames.

    Args:
        recording: without faces it has no surface frames.
        split: of its poses; only training poses are evaluated.
        tolerance_mm: as in `TrainingConfig`; vertices that the joints alone place within it are no candidates.
        should_stop: called before each partition.

    Returns:
        The surface frames, `NO_SURFACE_FRAMES` for a rig that does not smooth.

    Raises:
        Cancelled: `should_stop` returned True.
    """
    rig = recording.rig
    if not len(rig.face_starts):
        return NO_SURFACE_FRAMES
    training = split.training[np.unique(np.linspace(0, len(split.training) - 1, MAX_POSES).astype(np.int64))]
    matrices, corners = np.array(recording.pose_matrices[training]), _corners(rig)
    skin = skin_matrices(matrices, rig.rest_matrices)
    corner_counts = np.diff(corners.starts)
    max_corners = min(np.quantile(corner_counts[corner_counts > 0], CORNER_COUNT_QUANTILE), MAX_CORNERS)
    is_usable = (corner_counts > 0) & (corner_counts <= max_corners)
    min_score = (tolerance_mm / (1000 * rig.metres_per_unit)) ** 2
    candidates, column_spaces = [], {}
    for index, partition in enumerate(recording.partitions):
        if should_stop():
            raise Cancelled
        regression = joint_regression(rig, partition, skin)
        if regression.is_determined():
            column_space = regression.column_space()
            vertices = partition.vertices[is_usable[partition.vertices]]
            residuals = np.asarray(recording.residuals[np.ix_(training, vertices)], np.float32)
            candidates += _candidates(residuals, column_space, vertices, index, partition.joint, min_score)
            column_spaces[index] = column_space
    poses = _Poses(matrices, np.linalg.inv(skin[:, :, :3, :3].astype(np.float64)), column_spaces)
    candidates.sort(key=lambda candidate: -candidate.score)
    candidates = candidates[: min(MEAN_PER_PARTITION * len(recording.partitions), MAX_JOINT_ENTRIES // len(rig.joints))]
    if not candidates:
        return NO_SURFACE_FRAMES
    smoothed = _SmoothedSurface(rig, corners)
    iterations = _best_iterations(smoothed, candidates[:MAX_PROBED_CANDIDATES], poses)
    candidates.sort(key=lambda candidate: (candidate.partition, candidate.vertex))
    surface_frames = next(frames for count, frames in smoothed.surface_frames(candidates) if count == iterations)
    lengths, explained = _fit(surface_frames, candidates, poses)
    # Not inverted: a comparison with NaN is False.
    if not (explained.max() >= MIN_BEST_EXPLAINED_VARIANCE and np.median(explained) >= MIN_EXPLAINED_VARIANCE):
        return NO_SURFACE_FRAMES
    return replace(surface_frames, lengths=lengths).subset(explained >= MIN_EXPLAINED_VARIANCE)


def _corners(rig: Rig) -> _Corners:
    order = np.argsort(rig.face_vertices, kind="stable")
    starts = np.searchsorted(rig.face_vertices[order], np.arange(rig.vertex_count + 1))
    adjacent = adjacent_corners(rig.face_starts, rig.face_vertices)
    return _Corners(starts, *(rig.face_vertices[corners[order]] for corners in adjacent))


def _project_out(column_space: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Remove from (3 n, m) values their projection on an orthonormal basis (3 n, r)."""
    return values - column_space @ (column_space.T @ values)


def _candidates(
    residuals: np.ndarray, column_space: np.ndarray, vertices: np.ndarray, partition: int, joint: int, min_score: float
) -> list[_Candidate]:
    """Select candidates of a partition greedily: each is the vertex that joints and earlier candidates explain worst.

    Args:
        residuals: (n, v, 3) float32 local residuals of the usable vertices, mesh units.
        column_space: (3 n, r) orthonormal basis of what the joints explain.
        vertices: (v,) indices of the usable vertices.
        partition, joint: indices of the partition and its main joint.
        min_score: mean square below which no further candidate is selected, square mesh units.
    """
    pose_count, candidates = len(residuals), []
    flat = residuals.transpose(0, 2, 1).reshape(3 * pose_count, -1)
    unexplained = _project_out(column_space.astype(np.float32), flat)
    remaining = unexplained.reshape(pose_count, -1).copy()
    by_axis = remaining.reshape(pose_count, 3, -1)
    while len(candidates) < min(MAX_PER_PARTITION, len(vertices)):
        scores = np.einsum("nav,nav->v", by_axis, by_axis) / pose_count
        worst = int(scores.argmax())
        if scores[worst] <= min_score:
            break
        residual = unexplained[:, worst].astype(np.float64)
        candidates.append(_Candidate(int(vertices[worst]), partition, joint, float(scores[worst]), residual))
        selected = by_axis[:, :, worst].copy()
        gram = selected.T.astype(np.float64) @ selected
        gram += MIN_SINGULAR_VALUE_RATIO**2 * np.trace(gram) * np.eye(3)
        remaining -= selected @ np.linalg.solve(gram, selected.T @ remaining).astype(np.float32)
    return candidates


class _SmoothedSurface:
    """The linearly skinned surface, smoothed as by a simple Corrective Smooth."""

    def __init__(self, rig: Rig, corners: _Corners):
        self._corners, count = corners, rig.vertex_count
        corner_vertices = np.repeat(np.arange(count), np.diff(corners.starts))
        edges = np.concatenate([corner_vertices] * 2), np.concatenate([corners.before, corners.after])
        adjacency = sparse.coo_array((np.ones(len(edges[0])), edges), (count, count)).tocsr()
        adjacency.data[:] = 1
        degree = np.asarray(adjacency.sum(axis=1)).ravel()
        isolated = sparse.diags_array((degree == 0).astype(float))
        mean = sparse.diags_array(1 / np.maximum(degree, 1)) @ adjacency + isolated
        self._smoothing_step = ((1 - SMOOTHING_FACTOR) * sparse.eye_array(count) + SMOOTHING_FACTOR * mean).tocsr()
        vertices = np.repeat(np.arange(count), rig.skin_joints.shape[1])
        weights, joints = rig.skin_weights.ravel().astype(np.float64), rig.skin_joints.ravel()
        rest = np.append(rig.rest_positions.astype(np.float64), np.ones((count, 1)), axis=1)
        values = weights[:, None] * rest[vertices]
        coordinates = np.repeat(vertices, 4), (4 * joints[:, None] + np.arange(4)).ravel()
        self._weighted_rest = sparse.coo_array((values.ravel(), coordinates), (count, 4 * len(rig.joints))).tocsr()
        self._inverse_rest = np.linalg.inv(rig.rest_matrices.astype(np.float64))

    def surface_frames(self, candidates: Sequence[_Candidate]) -> Iterator[tuple[int, SurfaceFrameFeatures]]:
        """Compute the surface frames of the candidates, all lengths 1, at each of `SMOOTHING_ITERATIONS`.

        Yields:
            The number of iterations, and the surface frames.
        """
        vertices, joints = np.array([(candidate.vertex, candidate.joint) for candidate in candidates], np.int64).T
        starts, counts = self._corners.starts[vertices], np.diff(self._corners.starts)[vertices]
        slots = np.arange(counts.max())
        is_corner, corners = slots < counts[:, None], starts[:, None] + np.minimum(slots, counts[:, None] - 1)
        # Both edges of a padded corner have length 0.
        ends = np.where(is_corner, (self._corners.before[corners], self._corners.after[corners]), vertices[:, None])
        nearby, positions = np.unique(np.append(ends.ravel(), vertices), return_inverse=True)
        shape, completed = (len(nearby), self._smoothing_step.shape[0]), 0
        rows = sparse.csr_array((np.ones(len(nearby)), (np.arange(len(nearby)), nearby)), shape)
        for iterations in SMOOTHING_ITERATIONS:
            for _ in range(iterations - completed):
                rows = rows @ self._smoothing_step
            completed = iterations
            smoothed = (rows @ self._weighted_rest).toarray()[positions]
            before, after = smoothed[: ends.size].reshape(*ends.shape, -1) - smoothed[ends.size :, None]
            tangents = np.stack([before + after, after - before])
            by_joint = tangents.reshape(*tangents.shape[:3], -1, 4)
            # In the rest pose skin matrices are the identity, so the sum over the joints is the tangent.
            extent = np.linalg.norm(by_joint[..., :3].sum(axis=3), axis=3).max(axis=0)
            epsilons = np.maximum(EPSILON_RATIO * np.stack([extent, extent, extent**2]), MIN_EXTENT)
            posed = np.einsum("jab,fdkjb->fdkja", self._inverse_rest, by_joint).reshape(tangents.shape)
            lengths = np.tile(is_corner, (3, 1, 1)).astype(np.float64)
            yield iterations, SurfaceFrameFeatures(vertices, joints, posed, epsilons, lengths)


def _best_iterations(smoothed: _SmoothedSurface, candidates: Sequence[_Candidate], poses: _Poses) -> int:
    """Return the number of smoothing iterations at which the corners explain most of the candidates' residuals."""
    squares = np.array([candidate.residual @ candidate.residual for candidate in candidates])
    explained = {
        iterations: float(_fit(surface_frames, candidates, poses)[1] @ squares / squares.sum())
        for iterations, surface_frames in smoothed.surface_frames(candidates)
    }
    return max(explained, key=explained.__getitem__)


def _fit(
    surface_frames: SurfaceFrameFeatures, candidates: Sequence[_Candidate], poses: _Poses
) -> tuple[np.ndarray, np.ndarray]:
    """Fit the lengths of tangents and normals to the candidates' residuals.

    Returns:
        (3, D, K) lengths, mesh units, and (D,) the explained part of the squared residual.
    """
    to_local = poses.to_local[:, surface_frames.main_joints]
    vectors = np.einsum("ndab,nfdkb->dnafk", to_local, surface_frames.corner_vectors(poses.matrices))
    lengths, explained = np.zeros_like(surface_frames.lengths), np.zeros(len(surface_frames))
    for index, candidate in enumerate(candidates):
        is_used, residual = surface_frames.lengths[:, index] != 0, candidate.residual
        values = vectors[index][..., is_used].reshape(len(residual), -1)
        values = _project_out(poses.column_spaces[candidate.partition], values)
        gram = values.T @ values + RIDGE_RADIANS**2 * len(poses.matrices) * np.eye(is_used.sum())
        lengths[:, index][is_used] = np.linalg.solve(gram, values.T @ residual)
        error = residual - values @ lengths[:, index][is_used]
        explained[index] = 1 - error @ error / (residual @ residual)
    return lengths, explained
