# SPDX-License-Identifier: GPL-3.0-or-later
"""Chooses the vertices whose deltas networks see, and fits them to the recording.

Nothing is asked of the modifiers: a rig may smooth by others, or by nodes. What skinning to the joints around leaves of
the residuals is compared with the corners of linear skinning's surface, smoothed more and more; a rig that smooths
answers to one of these, another to none.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from fdda_addon.core.recording.reader import Recording
from fdda_addon.core.rig import Rig
from fdda_addon.core.skinning import skin_matrices
from fdda_addon.core.surface import adjacent_corners

from .data import Split
from .deltas import MOST_PARTS, NO_DELTAS, Deltas
from .joint_fit import RANK, surroundings_of_rig
from .process import Cancelled

MOST_POSES = 400
"""So many of the training poses are looked at."""
MOST_PER_PARTITION, MEAN_PER_PARTITION = 8, 3
COMMON_CORNERS, MOST_CORNERS = 0.75, 16
"""A vertex with more corners than this part of the vertices have, or than so many, is no candidate: all that are chosen
are padded to the one with most."""
ITERATIONS = (2, 3, 4, 5, 6, 8, 10, 12, 14, 16, 20, 24, 28, 32, 40, 48, 56, 64)
FACTOR = 0.5
"""Of each iteration: one of twice the factor smooths about as much as two."""
LEAST_EXPLAINED, SMOOTHS = 0.8, 0.95
"""Part of a vertex's squared residual, of what the joints leave, that its corners have to explain, on a rig that
smooths those of half the vertices; and that they explain somewhere on it. What bends with the joints comes to 0.94 by
chance."""
DAMPING = 0.01
"""What `Deltas.least` is of the longer tangent of the corner in the rest pose, of the normal of its square: a vector
that rounding would turn fades."""
TRIED = 24
"""Vertices that say how smooth the surface is."""
SMALLEST_EXTENT = 1e-18
"""Of a corner without any."""
RIDGE = 0.03
"""Tangents and normals, and sums of them, that turn by fewer radians against the joints fit next to nothing: it would
take lengths with which their rounding counts."""


@dataclass(frozen=True)
class _Candidate:
    """A vertex, and what the joints leave of its residual in the poses that are looked at.

    Attributes:
        vertex, partition, joint: their numbers; the joint is the partition's main joint.
        score: mean square of what is left beside other candidates of the partition, square mesh units.
        left: (3 n,) float64, mesh units, seen from the main joint.
    """

    vertex: int
    partition: int
    joint: int
    score: float
    left: np.ndarray


@dataclass(frozen=True)
class _Corners:
    """The corners of the faces at each vertex.

    Attributes:
        starts: (V + 1,) where those of each vertex begin.
        before, after: (C,) vertices beside it, along the face.
    """

    starts: np.ndarray
    before: np.ndarray
    after: np.ndarray


@dataclass(frozen=True)
class _Poses:
    """The poses that are looked at, n of them.

    Attributes:
        matrices: (n, J, 4, 4) pose matrices, mesh-object space, mesh units.
        axes: (n, J, 3, 3) float64, turn a vector of mesh-object space into the frame of a main joint's residuals.
        directions: of partitions by their number (3 n, r), an orthonormal basis of what the joints around explain.
    """

    matrices: np.ndarray
    axes: np.ndarray
    directions: dict[int, np.ndarray]


def find_deltas(
    recording: Recording, split: Split, tolerance_mm: float, should_stop: Callable[[], bool] = lambda: False
) -> Deltas:
    """Choose vertices of each partition that say most of its residuals, and fit their deltas.

    Args:
        recording: with the faces of its mesh, or there are none to find.
        split: its poses; only those that train are looked at.
        tolerance_mm: as in `TrainingConfig`: vertices that the joints alone place so well are left out.
        should_stop: asked before every partition.

    Raises:
        Cancelled: `should_stop` said so.
    """
    rig = recording.rig
    if not len(rig.face_starts):
        return NO_DELTAS
    training = split.training[np.unique(np.linspace(0, len(split.training) - 1, MOST_POSES).astype(np.int64))]
    matrices, corners = np.array(recording.pose_matrices[training]), _corners(rig)
    skin = skin_matrices(matrices, rig.rest_matrices)
    count = np.diff(corners.starts)
    usable = (count > 0) & (count <= min(np.quantile(count[count > 0], COMMON_CORNERS), MOST_CORNERS))
    least = (tolerance_mm / (1000 * rig.metres_per_unit)) ** 2
    candidates, directions = [], {}
    for number, partition in enumerate(recording.partitions):
        if should_stop():
            raise Cancelled
        surroundings = surroundings_of_rig(rig, partition, skin)
        if surroundings.are_determined():
            own = surroundings.directions()
            vertices = partition.vertices[usable[partition.vertices]]
            residuals = np.asarray(recording.residuals[np.ix_(training, vertices)], np.float32)
            candidates += _candidates(residuals, own, vertices, number, partition.joint, least)
            directions[number] = own
    poses = _Poses(matrices, np.linalg.inv(skin[:, :, :3, :3].astype(np.float64)), directions)
    candidates.sort(key=lambda own: -own.score)
    candidates = candidates[: min(MEAN_PER_PARTITION * len(recording.partitions), MOST_PARTS // len(rig.joints))]
    if not candidates:
        return NO_DELTAS
    smoothed = _SmoothedSurface(rig, corners)
    iterations = _how_smooth(smoothed, candidates[:TRIED], poses)
    candidates.sort(key=lambda own: (own.partition, own.vertex))
    deltas = next(deltas for number, deltas in smoothed.deltas(candidates) if number == iterations)
    lengths, parts = _fit(deltas, candidates, poses)
    smooths = parts.max() >= SMOOTHS and np.median(parts) >= LEAST_EXPLAINED
    return replace(deltas, lengths=lengths).chosen(parts >= LEAST_EXPLAINED) if smooths else NO_DELTAS


def _corners(rig: Rig) -> _Corners:
    order = np.argsort(rig.face_vertices, kind="stable")
    starts = np.searchsorted(rig.face_vertices[order], np.arange(rig.vertex_count + 1))
    beside = adjacent_corners(rig.face_starts, rig.face_vertices)
    return _Corners(starts, *(rig.face_vertices[corners[order]] for corners in beside))


def _without(directions: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(3 n, ·) values without what lies in the directions."""
    return values - directions @ (directions.T @ values)


def _candidates(
    residuals: np.ndarray, directions: np.ndarray, vertices: np.ndarray, number: int, joint: int, least: float
) -> list[_Candidate]:
    """The vertices of a partition one after the other that are worst when the former are known.

    Args:
        residuals: (n, v, 3) float32, local, mesh units; of those vertices that can be one.
        directions: (3 n, r) what the joints explain.
        vertices: (v,) their numbers.
        number, joint: of the partition.
        least: mean square that is to be left of a vertex, square mesh units.
    """
    poses, found = len(residuals), []
    flat = residuals.transpose(0, 2, 1).reshape(3 * poses, -1)
    whole = _without(directions.astype(np.float32), flat)
    left = whole.reshape(poses, -1).copy()
    by_axis = left.reshape(poses, 3, -1)
    while len(found) < min(MOST_PER_PARTITION, len(vertices)):
        scores = np.einsum("nav,nav->v", by_axis, by_axis) / poses
        worst = int(scores.argmax())
        if scores[worst] <= least:
            break
        alone = whole[:, worst].astype(np.float64)
        found.append(_Candidate(int(vertices[worst]), number, joint, float(scores[worst]), alone))
        own = by_axis[:, :, worst].copy()
        products = own.T.astype(np.float64) @ own
        products += RANK**2 * np.trace(products) * np.eye(3)
        left -= own @ np.linalg.solve(products, own.T @ left).astype(np.float32)
    return found


class _SmoothedSurface:
    """Linear skinning's surface at chosen vertices, smoothed as by a simple Corrective Smooth."""

    def __init__(self, rig: Rig, corners: _Corners):
        self._corners, count = corners, rig.vertex_count
        of_corner = np.repeat(np.arange(count), np.diff(corners.starts))
        pairs = np.concatenate([of_corner, of_corner]), np.concatenate([corners.before, corners.after])
        beside = sparse.coo_array((np.ones(len(pairs[0])), pairs), (count, count)).tocsr()
        beside.data[:] = 1
        number = np.asarray(beside.sum(axis=1)).ravel()
        mean = sparse.diags_array(1 / np.maximum(number, 1)) @ beside + sparse.diags_array((number == 0).astype(float))
        self._step = ((1 - FACTOR) * sparse.eye_array(count) + FACTOR * mean).tocsr()
        vertices = np.repeat(np.arange(count), rig.skin_joints.shape[1])
        weights, joints = rig.skin_weights.ravel().astype(np.float64), rig.skin_joints.ravel()
        rest = np.append(rig.rest_positions.astype(np.float64), np.ones((count, 1)), axis=1)
        parts = weights[:, None] * rest[vertices]
        places = np.repeat(vertices, 4), (4 * joints[:, None] + np.arange(4)).ravel()
        self._weighted = sparse.coo_array((parts.ravel(), places), (count, 4 * len(rig.joints))).tocsr()
        self._inverse_rest = np.linalg.inv(rig.rest_matrices.astype(np.float64))

    def deltas(self, candidates: Sequence[_Candidate]) -> Iterator[tuple[int, Deltas]]:
        """The deltas of some vertices with lengths of 1, each of `ITERATIONS` with what it makes of the surface."""
        vertices, joints = np.array([(own.vertex, own.joint) for own in candidates], np.int64).T
        starts, counts = self._corners.starts[vertices], np.diff(self._corners.starts)[vertices]
        number = np.arange(counts.max())
        there, corner = number < counts[:, None], starts[:, None] + np.minimum(number, counts[:, None] - 1)
        # Padded corners lie between the vertex and itself.
        ends = np.where(there, (self._corners.before[corner], self._corners.after[corner]), vertices[:, None])
        around, places = np.unique(np.append(ends.ravel(), vertices), return_inverse=True)
        size, done = (len(around), self._step.shape[0]), 0
        rows = sparse.csr_array((np.ones(len(around)), (np.arange(len(around)), around)), size)
        for iterations in ITERATIONS:
            for _ in range(iterations - done):
                rows = rows @ self._step
            done = iterations
            parts = (rows @ self._weighted).toarray()[places]
            before, after = parts[: ends.size].reshape(*ends.shape, -1) - parts[ends.size :, None]
            tangents = np.stack([before + after, after - before])
            by_joint = tangents.reshape(*tangents.shape[:3], -1, 4)
            # In the rest pose skin matrices are the identity, and the parts of a tangent add up to it.
            extent = np.linalg.norm(by_joint[..., :3].sum(axis=3), axis=3).max(axis=0)
            least = np.maximum(DAMPING * np.stack([extent, extent, extent**2]), SMALLEST_EXTENT)
            posed = np.einsum("jab,fdkjb->fdkja", self._inverse_rest, by_joint).reshape(tangents.shape)
            yield iterations, Deltas(vertices, joints, posed, least, np.tile(there, (3, 1, 1)).astype(np.float64))


def _how_smooth(smoothed: _SmoothedSurface, candidates: Sequence[_Candidate], poses: _Poses) -> int:
    """How many times to smooth the surface, so that its corners explain most."""
    squares = np.array([own.left @ own.left for own in candidates])
    parts = {
        iterations: float(_fit(deltas, candidates, poses)[1] @ squares / squares.sum())
        for iterations, deltas in smoothed.deltas(candidates)
    }
    return max(parts, key=parts.__getitem__)


def _fit(deltas: Deltas, candidates: Sequence[_Candidate], poses: _Poses) -> tuple[np.ndarray, np.ndarray]:
    """Fit what tangents and normals count for to what joints leave.

    Returns:
        (3, D, K) lengths, mesh units, and (D,) the part of the squared residual that they explain.
    """
    axes = poses.axes[:, deltas.seen_from]
    frames = np.einsum("ndab,nfdkb->dnafk", axes, deltas.frames(poses.matrices))
    lengths, parts = np.zeros_like(deltas.lengths), np.zeros(len(deltas))
    for number, own in enumerate(candidates):
        used = deltas.lengths[:, number] != 0
        values = _without(poses.directions[own.partition], frames[number][..., used].reshape(len(own.left), -1))
        products = values.T @ values + RIDGE**2 * len(poses.matrices) * np.eye(used.sum())
        lengths[:, number][used] = np.linalg.solve(products, values.T @ own.left)
        left = own.left - values @ lengths[:, number][used]
        parts[number] = 1 - left @ left / (own.left @ own.left)
    return lengths, parts
