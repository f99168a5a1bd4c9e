# SPDX-License-Identifier: GPL-3.0-or-later
"""Moves the borders of partitions to where fewer numbers say the same.

A vertex counts to the partition of its main joint, whichever joint its residual follows. Near a border, the shapes of
the partition beside it may say it better: what moves there moves as one, and both partitions need fewer shapes when one
of them has it. So vertices change over as long as that pays, shapes and borders in turns, as subspaces are clustered
(Bradley and Mangasarian, k-Plane Clustering, 2000); a partition keeps its main joint, frame and inputs.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from fdda_addon.core.defaults import MIN_PARTITION_VERTICES
from fdda_addon.core.partition import Partition
from fdda_addon.core.recording.reader import Recording
from fdda_addon.core.surface import Surface

from .basis import FINER, make_basis, share_shapes
from .data import MARGIN_WEIGHT, Split, residuals_of
from .joint_fit import RANK, surroundings_of_rig
from .process import Cancelled
from .turns import fit_matrices

MOST_POSES = 300
"""So many of the training poses are looked at."""
MOST_FLOATS = 1 << 26
"""Fewer poses of a mesh whose residuals would be more coordinates than this."""
MOST_ROUNDS = 8
WORTHWHILE, NEEDED = 0.98, 0.9
"""A further round has to leave at most the first part of the numbers, and all rounds the second: where weights say it
nearly as well, partitions stay as they were painted, and no rounding decides."""
REACH = 2
"""How many edges a border may move in a round."""
PRICE = 0.25
"""What a shape has to save of a vertex, as a part of what the last shapes save for their numbers. With the whole of it
vertices with next to no residual move for it alone, and borders are ragged; with nothing, partitions with many shapes
take what needs few."""
LEAST_OTHERS = 0.1
"""A pose that no other resembles counts as if they said this much of it."""


@dataclass(frozen=True)
class _Shapes:
    """What the partitions come to as they are cut.

    Attributes:
        coefficients: by partition, (n, K) float32, mesh units.
        price: square mesh units that one number more takes off the squared residuals, where it takes off the most.
        numbers: that their matrices have, the factors of the joints around left out, and their networks' last layers.
    """

    coefficients: dict[int, np.ndarray]
    price: float
    numbers: int


class _Cut:
    """Partitions that change their vertices, and what the joints around leave of the residuals.

    Attributes:
        owner: (V,) int64, the partition of each vertex.
    """

    def __init__(self, recording: Recording, split: Split, turns: bool, tolerance: float, units: int):
        """Args:
        recording, split, turns: as in `better_borders`.
        tolerance, units: as in `share_shapes`.
        """
        rig, self._recording, self._partitions = recording.rig, recording, recording.partitions
        most = min(MOST_POSES, MOST_FLOATS // (3 * rig.vertex_count))
        picked = np.unique(np.linspace(0, len(split.training) - 1, most).astype(np.int64))
        self._poses, self._weights = split.training[picked], split.weights(MARGIN_WEIGHT)[picked]
        self._tolerance, self._units = tolerance, units
        matrices = fit_matrices(np.array(recording.pose_matrices[self._poses]), rig, turns)
        self._directions = {}
        for number, own in enumerate(self._partitions):
            surroundings = surroundings_of_rig(rig, own, matrices)
            # What sees nothing gives and takes nothing.
            if (own.influencing or own.controls) and surroundings.are_determined():
                self._directions[number] = surroundings.directions().astype(np.float32)
        self._able = list(self._directions)
        self.owner = self._first = partition_of(self._partitions)
        edges, size = Surface(rig.face_starts, rig.face_vertices).edges, (rig.vertex_count,) * 2
        beside = sparse.coo_array((np.ones(len(edges)), edges.T), size)
        self._around = (beside + beside.T + sparse.eye_array(rig.vertex_count)).tocsr()
        self._left = np.zeros((len(self._poses), rig.vertex_count, 3), np.float32)
        for number in self._able:
            own = self._partitions[number].vertices
            self._left[:, own] = self._left_of(number, own)

    def _left_of(self, number: int, vertices: np.ndarray) -> np.ndarray:
        """(n, v, 3) float32, what the joints around a partition leave of vertices, as its main joint sees it."""
        partition, poses = replace(self._partitions[number], vertices=vertices), len(self._poses)
        residuals = residuals_of(self._recording, partition, self._poses)
        flat = residuals.transpose(0, 2, 1).reshape(3 * poses, len(vertices))
        directions = self._directions[number]
        left = flat - directions @ (directions.T @ flat)
        return left.reshape(poses, 3, len(vertices)).transpose(0, 2, 1)

    def shapes(self) -> _Shapes:
        """Make the shapes of the partitions as they are."""
        bases, coefficients, numbers, skin = [], {}, 0, self._recording.rig
        owned = [np.flatnonzero(self.owner == number) for number in self._able]
        for own in owned:
            left = np.ascontiguousarray(self._left[:, own]).reshape(len(self._poses), -1)
            bases.append(make_basis(left, self._tolerance / FINER, np.random.default_rng(0), self._weights))
        sizes, lefts = [len(own) for own in owned], [basis.left for basis in bases]
        counts = share_shapes(lefts, sizes, self._tolerance, self._units)
        price = 0.0
        for number, own, basis, count in zip(self._able, owned, bases, counts, strict=True):
            left = self._left[:, own].reshape(len(self._poses), -1)
            coefficients[number] = basis.first(count).coefficients(left)
            joints = len(np.unique(skin.skin_joints[own][skin.skin_weights[own] > 0]))
            numbers += len(own) * (3 * count + 4 * joints) + self._units * count
            if count + 1 < len(basis.left):
                taken = len(own) * (basis.left[count] ** 2 - basis.left[count + 1] ** 2)
                price = max(price, float(taken) / (3 * len(own) + self._units))
        return _Shapes(coefficients, price, numbers)

    def move(self, shapes: _Shapes, should_stop: Callable[[], bool]) -> None:
        """Give each vertex near a border to the partition that says it for the least."""
        count = len(self.owner)
        places = np.arange(count), self.owner
        near = sparse.coo_array((np.ones(count), places), (count, len(self._partitions))).tocsr()
        for _ in range(REACH):
            near = self._around @ near
        contested = (np.diff(near.indptr) > 1) & np.isin(self.owner, self._able)
        near = near.tocsc()
        least, owner = np.full(count, np.inf), self.owner.copy()
        for number in self._able:
            if should_stop():
                raise Cancelled
            vertices = np.sort(near.indices[near.indptr[number] : near.indptr[number + 1]])
            vertices = vertices[contested[vertices]]
            cost = self._costs(number, vertices, shapes)
            cheaper = cost < least[vertices]
            least[vertices[cheaper]], owner[vertices[cheaper]] = cost[cheaper], number
        for number in self._able:
            before = self._first == number
            if (before & (owner == number)).sum() < min(MIN_PARTITION_VERTICES, before.sum()):
                owner[before] = number
        moved, self.owner = owner != self.owner, owner
        for number in np.unique(owner[moved]).tolist():
            came = np.flatnonzero(moved & (owner == number))
            self._left[:, came] = self._left_of(number, came)

    def _costs(self, number: int, vertices: np.ndarray, shapes: _Shapes) -> np.ndarray:
        """(v,) square mesh units: what a partition leaves of vertices, and what its shapes have to save of them."""
        own = self.owner[vertices] == number
        left = np.empty((len(self._poses), len(vertices), 3), np.float32)
        left[:, own], left[:, ~own] = self._left[:, vertices[own]], self._left_of(number, vertices[~own])
        roots = np.sqrt(self._weights)[:, None]
        coefficients = shapes.coefficients[number]
        known, sizes, _ = np.linalg.svd(
            np.append(coefficients, np.ones_like(roots), axis=1) * roots, full_matrices=False
        )
        known = known[:, sizes > RANK * sizes[0]]
        values = left.reshape(len(left), 3 * len(vertices)) * roots
        apart = values - known @ (known.T @ values)
        # Of each pose what the others leave: one that makes a shape of its own says nothing of the vertex.
        apart /= np.maximum(1 - (known**2).sum(axis=1), LEAST_OTHERS)[:, None]
        squares = (apart.reshape(left.shape) ** 2).sum(axis=(0, 2)) / self._weights.sum()
        return squares + PRICE * shapes.price * 3 * coefficients.shape[1]


def better_borders(
    recording: Recording,
    split: Split,
    turns: bool,
    tolerance_mm: float,
    units: int,
    should_stop: Callable[[], bool] = lambda: False,
) -> tuple[Partition, ...]:
    """The partitions of a recording with their borders where they need the fewest numbers.

    As long as a round of moves leaves at most `WORTHWHILE` of the numbers, there is another. A rig keeps its partitions
    where more than `NEEDED` of the numbers are left, and one without faces does.

    Args:
        recording: of the rig.
        split: its poses; only those that train are looked at.
        turns: whether residuals are fitted to turn matrices.
        tolerance_mm: as in `TrainingConfig`.
        units: of the last hidden layer.
        should_stop: asked often.

    Raises:
        Cancelled: `should_stop` said so.
    """
    rig = recording.rig
    if len(recording.partitions) < 2 or not len(rig.face_starts):
        return recording.partitions
    cut = _Cut(recording, split, turns, tolerance_mm / (1000 * rig.metres_per_unit), units + 1)
    shapes, owner = cut.shapes(), cut.owner
    first = fewest = shapes.numbers
    for _ in range(MOST_ROUNDS):
        cut.move(shapes, should_stop)
        shapes = cut.shapes()
        if shapes.numbers >= WORTHWHILE * fewest:
            break
        fewest, owner = shapes.numbers, cut.owner
    return recut(recording.partitions, owner) if fewest < NEEDED * first else recording.partitions


def recut(partitions: tuple[Partition, ...], partition_of: np.ndarray) -> tuple[Partition, ...]:
    """The same partitions with other vertices; `partition_of` (V,) has the number of each vertex's."""
    return tuple(
        replace(partition, vertices=np.flatnonzero(partition_of == number).astype(np.int32))
        for number, partition in enumerate(partitions)
    )


def partition_of(partitions: tuple[Partition, ...]) -> np.ndarray:
    """(V,) int64, the number of each vertex's partition."""
    found = np.empty(sum(len(partition.vertices) for partition in partitions), np.int64)
    for number, partition in enumerate(partitions):
        found[partition.vertices] = number
    return found
