# SPDX-License-Identifier: GPL-3.0-or-later
"""Chooses the vertices whose deltas networks see, and fits them to the recording.

Nothing is asked of the modifiers: a rig may smooth by others, or by nodes. What skinning to the joints around leaves of
the residuals is compared with the normals of the linear layer's surface, smoothed more and more; a rig that smooths
answers to one of these, another to none.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from fdda_addon.core.partition import Partition
from fdda_addon.core.recording.reader import Recording
from fdda_addon.core.rig import Rig
from fdda_addon.core.skinning import skin_matrices
from fdda_addon.core.surface import corners_beside

from .data import Split
from .deltas import MOST_PARTS, NO_DELTAS, Deltas
from .joint_fit import surroundings_of_rig

MOST_POSES = 400
"""So many of the training poses are looked at."""
MOST_PER_PARTITION, MEAN_PER_PARTITION = 8, 3
COMMON_CORNERS, MOST_CORNERS = 0.75, 16
"""A vertex with more corners than this part of the vertices have, or than so many, is no candidate: all that are chosen
are padded to the one with most."""
EQUATIONS = 4
"""Poses give at least so many equations for each number of the joints around a partition: with few all is explained."""
ITERATIONS = (2, 3, 4, 5, 6, 8, 10, 12, 14, 16, 20, 24, 28, 32, 40, 48, 56, 64)
FACTOR = 0.5
"""Of each iteration: one of twice the factor smooths about as much as two."""
LEAST_EXPLAINED, SMOOTHS = 0.8, 0.95
"""Part of a vertex's squared residual, of what the joints leave, that its normals have to explain; and that they
explain somewhere on a rig that smooths. Shape keys and lattices that bend with the joints come to 0.9 by chance."""
DAMPING = 0.01
"""What `Deltas.least` is of the area of the corner in the rest pose: a normal that rounding would turn fades."""
TRIED = 24
"""Vertices that say how smooth the surface is."""
SMALLEST_AREA = 1e-18
"""Square mesh units; of a corner without any."""
RIDGE = 0.03
"""Normals, and sums of them, that turn by fewer radians against the joints fit next to nothing: it would take lengths
with which their rounding counts."""
RANK = 1e-5
"""Directions that are smaller than this part of the largest are none."""


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
class _Fan:
    """The faces around a vertex.

    Attributes:
        vertex: its number.
        ends: (E,) the vertices beside it, ascending.
        before, after: (K,) of each corner, among the ends.
    """

    vertex: int
    ends: np.ndarray
    before: np.ndarray
    after: np.ndarray

    @staticmethod
    def at(corners: _Corners, vertex: int) -> "_Fan":
        own = slice(corners.starts[vertex], corners.starts[vertex + 1])
        ends, places = np.unique(np.concatenate([corners.before[own], corners.after[own]]), return_inverse=True)
        return _Fan(vertex, ends, *np.split(places, 2))


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


def find_deltas(recording: Recording, split: Split, tolerance_mm: float) -> Deltas:
    """Choose vertices of each partition that say most of its residuals, and fit their deltas.

    Args:
        recording: with the faces of its mesh, or there are none to find.
        split: its poses; only those that train are looked at.
        tolerance_mm: as in `TrainingConfig`: vertices that the joints alone place so well are left out.
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
        rows = surroundings_of_rig(rig, partition, skin).rows
        if EQUATIONS * rows.shape[2] <= 3 * len(rows):
            own = _directions(rows)
            residuals = np.asarray(recording.residuals[np.ix_(training, partition.vertices)], np.float32)
            found = _candidates(residuals, own, partition, number, usable[partition.vertices])
            candidates += [candidate for candidate in found if candidate.score > least]
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
    return replace(deltas, lengths=lengths).chosen(parts >= LEAST_EXPLAINED) if parts.max() >= SMOOTHS else NO_DELTAS


def _corners(rig: Rig) -> _Corners:
    order = np.argsort(rig.face_vertices, kind="stable")
    starts = np.searchsorted(rig.face_vertices[order], np.arange(rig.vertex_count + 1))
    beside = corners_beside(rig.face_starts, rig.face_vertices)
    return _Corners(starts, *(rig.face_vertices[corners[order]] for corners in beside))


def _directions(rows: np.ndarray) -> np.ndarray:
    """(n, 3, 4 Jf) rows to an orthonormal basis (3 n, r) of what they span."""
    flat = rows.reshape(-1, rows.shape[2])
    flat = flat / np.maximum(np.linalg.norm(flat, axis=0), np.finfo(np.float64).tiny)
    left, sizes, _ = np.linalg.svd(flat, full_matrices=False)
    return left[:, sizes > RANK * sizes[0]]


def _without(directions: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(3 n, ·) values without what lies in the directions."""
    return values - directions @ (directions.T @ values)


def _candidates(
    residuals: np.ndarray, directions: np.ndarray, partition: Partition, number: int, usable: np.ndarray
) -> list[_Candidate]:
    """The vertices of a partition one after the other that are worst when the former are known.

    Args:
        residuals: (n, Vp, 3) float32, local, mesh units.
        directions: (3 n, r) what the joints explain.
        partition, number: whose they are.
        usable: (Vp,) bool, whether a vertex can be one.
    """
    flat = residuals.transpose(0, 2, 1).reshape(-1, residuals.shape[1])
    usable = usable.copy()
    whole = _without(directions.astype(np.float32), flat).reshape(len(residuals), 3, -1)
    left, found = whole.copy(), []
    score = np.einsum("nav,nav->v", left, left) / len(left) * usable
    while len(found) < MOST_PER_PARTITION and (most := float(score.max(initial=0))) > 0:
        worst = int(score.argmax())
        own = left[:, :, worst].astype(np.float64)
        vertex, alone = int(partition.vertices[worst]), whole[:, :, worst].ravel().astype(np.float64)
        found.append(_Candidate(vertex, number, partition.joint, most, alone))
        products = own.T @ own
        products += RANK**2 * np.trace(products) * np.eye(3)
        known = np.linalg.solve(products, np.einsum("na,nbv->abv", own, left).reshape(3, -1))
        left -= (own @ known).reshape(left.shape).astype(np.float32)
        usable[worst] = False
        score = np.einsum("nav,nav->v", left, left) / len(left) * usable
    return found


class _SmoothedSurface:
    """The linear layer's surface at chosen vertices, smoothed as by a simple Corrective Smooth."""

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
        fans = [_Fan.at(self._corners, own.vertex) for own in candidates]
        around = np.unique(np.concatenate([[own.vertex for own in candidates], *(fan.ends for fan in fans)]))
        size, done = (len(around), self._step.shape[0]), 0
        rows = sparse.csr_array((np.ones(len(around)), (np.arange(len(around)), around)), size)
        for iterations in ITERATIONS:
            for _ in range(iterations - done):
                rows = rows @ self._step
            done = iterations
            weighted = (rows @ self._weighted).toarray().reshape(len(around), -1, 4)
            yield iterations, self._deltas(candidates, fans, around, weighted)

    def _deltas(
        self, candidates: Sequence[_Candidate], fans: Sequence[_Fan], around: np.ndarray, rows: np.ndarray
    ) -> Deltas:
        size, most = len(candidates), max(len(fan.before) for fan in fans)
        corners = np.zeros((2, size, most), np.int64)
        least, lengths, edges = np.ones((size, most)), np.zeros((size, most)), []
        for number, fan in enumerate(fans):
            own = np.stack([fan.before, fan.after])
            corners[:, number, : len(fan.before)] = sum(map(len, edges)) + own
            edges.append(np.subtract(*(rows[np.searchsorted(around, ends)] for ends in (fan.ends, [fan.vertex]))))
            # In the rest pose skin matrices are the identity, and the parts of an edge add up to it.
            area = np.linalg.norm(np.cross(*edges[-1][..., :3].sum(axis=1)[own]), axis=1)
            least[number, : len(area)] = np.maximum(DAMPING * area, SMALLEST_AREA)
            lengths[number, : len(area)] = 1
        numbers = (np.array([getattr(own, name) for own in candidates], np.int64) for name in ("vertex", "joint"))
        posed = np.einsum("jab,ejb->eja", self._inverse_rest, np.concatenate(edges))
        return Deltas(*numbers, posed.reshape(len(posed), -1), corners, least, lengths)


def _how_smooth(smoothed: _SmoothedSurface, candidates: Sequence[_Candidate], poses: _Poses) -> int:
    """How many times to smooth the surface, so that its normals explain most."""
    squares = np.array([own.left @ own.left for own in candidates])
    parts = {
        iterations: float(_fit(deltas, candidates, poses)[1] @ squares / squares.sum())
        for iterations, deltas in smoothed.deltas(candidates)
    }
    return max(parts, key=parts.__getitem__)


def _fit(deltas: Deltas, candidates: Sequence[_Candidate], poses: _Poses) -> tuple[np.ndarray, np.ndarray]:
    """Fit what normals count for to what joints leave.

    Returns:
        (D, K) lengths, mesh units, and (D,) the part of the squared residual that they explain.
    """
    axes = poses.axes[:, deltas.seen_from]
    normals = np.einsum("ndab,ndcb->dnac", axes, deltas.normals(poses.matrices))
    lengths, parts = np.zeros(deltas.lengths.shape), np.zeros(len(deltas))
    for number, own in enumerate(candidates):
        used = np.flatnonzero(deltas.lengths[number])
        values = normals[number].reshape(len(own.left), -1)[:, used]
        values = _without(poses.directions[own.partition], values)
        products = values.T @ values + RIDGE**2 * len(poses.matrices) * np.eye(len(used))
        lengths[number, used] = np.linalg.solve(products, values.T @ own.left)
        left = own.left - values @ lengths[number, used]
        parts[number] = 1 - left @ left / (own.left @ own.left)
    return lengths, parts
