# SPDX-License-Identifier: GPL-3.0-or-later
"""Reassigns vertices between neighboring partitions where that reduces the size of the model.

Each vertex starts in the partition of its main joint, even if its residual depends on another joint. Near a boundary,
the components of the neighboring partition may represent the residual better. If vertices that move together share one
basis, both partitions need fewer components. The refinement alternates between computing bases and reassigning
vertices, as in subspace clustering (Bradley and Mangasarian, k-Plane Clustering, 2000). A partition keeps its main
joint, space and inputs.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from fdda_addon.core.defaults import MIN_PARTITION_VERTICES
from fdda_addon.core.partition import Partition
from fdda_addon.core.recording.reader import Recording
from fdda_addon.core.surface import Surface

from ..data.residuals import residuals_of
from ..data.split import Split
from ..process import Cancelled
from .basis import FINE_TOLERANCE_FACTOR, allocate_components, make_basis
from .half_rotations import regression_matrices
from .joint_fit import MIN_SINGULAR_VALUE_RATIO, joint_regression

MAX_POSES = 300
"""Maximum number of training poses that are evaluated."""
MAX_ELEMENTS = 1 << 26
"""Maximum number of residual coordinates of all evaluated poses; large meshes are evaluated in fewer poses."""
MAX_ROUNDS = 8
MAX_ROUND_SIZE_RATIO, MAX_SIZE_RATIO = 0.98, 0.9
"""Maximum ratio of the new size to the former size, for one more round and for all rounds together. If refinement
reduces the size less, partitions stay unchanged, so that the result does not depend on rounding."""
REASSIGNMENT_EDGES = 2
"""Distance in edges within which a round reassigns vertices across a boundary."""
COMPONENT_COST = 0.25
"""Cost of a component for a vertex, as a part of the squared residual that the last components remove. At 1, vertices
with almost no residual move only because of this cost, and boundaries become ragged. At 0, partitions with many
components take vertices that need few components."""
MIN_LEVERAGE_DIVISOR = 0.1
"""Minimum of 1 - leverage of a pose, so that the error of a pose that differs from all others stays bounded."""


@dataclass(frozen=True)
class _Bases:
    """Bases of the current partitions.

    Attributes:
        coefficients: (n, K) float32 coefficients by partition index, mesh units.
        gain_per_parameter: squared residual that one more model parameter removes in the partition where it removes
            most, square mesh units.
        parameter_count: number of parameters of the partitions' matrices, without the factors of the joint fit, and of
            the output layers.
    """

    coefficients: dict[int, np.ndarray]
    gain_per_parameter: float
    parameter_count: int


class _Refinement:
    """The state of a refinement: the partition of each vertex, and the residuals that nearby joints do not explain.

    Attributes:
        partition_by_vertex: (V,) int64, partition index of each vertex.
    """

    def __init__(
        self,
        recording: Recording,
        split: Split,
        use_half_rotations: bool,
        tolerance: float,
        parameters_per_component: int,
    ):
        """Fit the joints and start from the partitions of the recording.

        Args:
            recording, split, use_half_rotations: as in `refine_partitions`.
            tolerance, parameters_per_component: as in `allocate_components`.
        """
        rig, self._recording, self._partitions = recording.rig, recording, recording.partitions
        max_poses = min(MAX_POSES, MAX_ELEMENTS // (3 * rig.vertex_count))
        sampled_rows = np.unique(np.linspace(0, len(split.training) - 1, max_poses).astype(np.int64))
        self._poses, self._pose_weights = split.training[sampled_rows], split.weights()[sampled_rows]
        self._tolerance, self._parameters_per_component = tolerance, parameters_per_component
        matrices = regression_matrices(np.array(recording.pose_matrices[self._poses]), rig, use_half_rotations)
        self._column_spaces = {}
        for index, partition in enumerate(self._partitions):
            regression = joint_regression(rig, partition, matrices)
            # A partition without inputs keeps its vertices.
            if (partition.influencing or partition.controls) and regression.is_determined():
                self._column_spaces[index] = regression.column_space().astype(np.float32)
        self._refinable = list(self._column_spaces)
        self.partition_by_vertex = self._initial_partition_by_vertex = partition_indices(self._partitions)
        edges, shape = Surface(rig.face_starts, rig.face_vertices).edges, (rig.vertex_count,) * 2
        adjacency = sparse.coo_array((np.ones(len(edges)), edges.T), shape)
        self._adjacency = (adjacency + adjacency.T + sparse.eye_array(rig.vertex_count)).tocsr()
        self._unexplained = np.zeros((len(self._poses), rig.vertex_count, 3), np.float32)
        for index in self._refinable:
            vertices = self._partitions[index].vertices
            self._unexplained[:, vertices] = self._unexplained_by(index, vertices)

    def _unexplained_by(self, index: int, vertices: np.ndarray) -> np.ndarray:
        """Return the part of the vertices' residuals that a partition's joints do not explain.

        Returns:
            (n, v, 3) float32, in the space of the partition's main joint, mesh units.
        """
        partition, pose_count = replace(self._partitions[index], vertices=vertices), len(self._poses)
        residuals = residuals_of(self._recording, partition, self._poses)
        flat = residuals.transpose(0, 2, 1).reshape(3 * pose_count, len(vertices))
        column_space = self._column_spaces[index]
        unexplained = flat - column_space @ (column_space.T @ flat)
        return unexplained.reshape(pose_count, 3, len(vertices)).transpose(0, 2, 1)

    def bases(self) -> _Bases:
        """Compute the bases of the current partitions."""
        bases, coefficients, parameter_count, rig = [], {}, 0, self._recording.rig
        vertices_of = [np.flatnonzero(self.partition_by_vertex == index) for index in self._refinable]
        for vertices in vertices_of:
            unexplained = np.ascontiguousarray(self._unexplained[:, vertices]).reshape(len(self._poses), -1)
            tolerance = self._tolerance / FINE_TOLERANCE_FACTOR
            bases.append(make_basis(unexplained, tolerance, np.random.default_rng(0), self._pose_weights))
        vertex_counts = [len(vertices) for vertices in vertices_of]
        errors = [basis.error_by_count for basis in bases]
        counts = allocate_components(errors, vertex_counts, self._tolerance, self._parameters_per_component)
        gain_per_parameter = 0.0
        for index, vertices, basis, count in zip(self._refinable, vertices_of, bases, counts, strict=True):
            unexplained = self._unexplained[:, vertices].reshape(len(self._poses), -1)
            coefficients[index] = basis.truncate(count).project(unexplained)
            joint_count = len(np.unique(rig.skin_joints[vertices][rig.skin_weights[vertices] > 0]))
            parameter_count += len(vertices) * (3 * count + 4 * joint_count) + self._parameters_per_component * count
            if count + 1 < len(basis.error_by_count):
                removed_squares = len(vertices) * (
                    basis.error_by_count[count] ** 2 - basis.error_by_count[count + 1] ** 2
                )
                gain_per_parameter = max(
                    gain_per_parameter, float(removed_squares) / (3 * len(vertices) + self._parameters_per_component)
                )
        return _Bases(coefficients, gain_per_parameter, parameter_count)

    def reassign(self, bases: _Bases, should_stop: Callable[[], bool]) -> None:
        """Assign each vertex near a boundary to the partition with the lowest cost.

        Raises:
            Cancelled: `should_stop` returned True.
        """
        vertex_count = len(self.partition_by_vertex)
        coordinates = np.arange(vertex_count), self.partition_by_vertex
        reachable = sparse.coo_array(
            (np.ones(vertex_count), coordinates), (vertex_count, len(self._partitions))
        ).tocsr()
        for _ in range(REASSIGNMENT_EDGES):
            reachable = self._adjacency @ reachable
        is_contested = (np.diff(reachable.indptr) > 1) & np.isin(self.partition_by_vertex, self._refinable)
        reachable = reachable.tocsc()
        min_cost, new_partition_by_vertex = np.full(vertex_count, np.inf), self.partition_by_vertex.copy()
        for index in self._refinable:
            if should_stop():
                raise Cancelled
            vertices = np.sort(reachable.indices[reachable.indptr[index] : reachable.indptr[index + 1]])
            vertices = vertices[is_contested[vertices]]
            costs = self._costs(index, vertices, bases)
            is_cheaper = costs < min_cost[vertices]
            min_cost[vertices[is_cheaper]], new_partition_by_vertex[vertices[is_cheaper]] = costs[is_cheaper], index
        for index in self._refinable:
            is_initial = self._initial_partition_by_vertex == index
            if (is_initial & (new_partition_by_vertex == index)).sum() < min(MIN_PARTITION_VERTICES, is_initial.sum()):
                new_partition_by_vertex[is_initial] = index
        is_moved, self.partition_by_vertex = (
            new_partition_by_vertex != self.partition_by_vertex,
            new_partition_by_vertex,
        )
        for index in np.unique(new_partition_by_vertex[is_moved]).tolist():
            added_vertices = np.flatnonzero(is_moved & (new_partition_by_vertex == index))
            self._unexplained[:, added_vertices] = self._unexplained_by(index, added_vertices)

    def _costs(self, index: int, vertices: np.ndarray, bases: _Bases) -> np.ndarray:
        """Return (v,) costs of vertices in a partition, square mesh units: squared residual plus component cost."""
        is_member = self.partition_by_vertex[vertices] == index
        unexplained = np.empty((len(self._poses), len(vertices), 3), np.float32)
        unexplained[:, is_member] = self._unexplained[:, vertices[is_member]]
        unexplained[:, ~is_member] = self._unexplained_by(index, vertices[~is_member])
        weight_roots = np.sqrt(self._pose_weights)[:, None]
        coefficients = bases.coefficients[index]
        left_vectors, singular_values, _ = np.linalg.svd(
            np.append(coefficients, np.ones_like(weight_roots), axis=1) * weight_roots, full_matrices=False
        )
        left_vectors = left_vectors[:, singular_values > MIN_SINGULAR_VALUE_RATIO * singular_values[0]]
        values = unexplained.reshape(len(unexplained), 3 * len(vertices)) * weight_roots
        errors = values - left_vectors @ (left_vectors.T @ values)
        # The errors are leave-one-out errors. A component that only one pose needs is no reason to assign a vertex.
        errors /= np.maximum(1 - (left_vectors**2).sum(axis=1), MIN_LEVERAGE_DIVISOR)[:, None]
        mean_squares = (errors.reshape(unexplained.shape) ** 2).sum(axis=(0, 2)) / self._pose_weights.sum()
        return mean_squares + COMPONENT_COST * bases.gain_per_parameter * 3 * coefficients.shape[1]


def refine_partitions(
    recording: Recording,
    split: Split,
    use_half_rotations: bool,
    tolerance_mm: float,
    last_hidden_units: int,
    should_stop: Callable[[], bool] = lambda: False,
) -> tuple[Partition, ...]:
    """Reassign vertices between neighboring partitions so that the model has fewer parameters.

    Rounds continue as long as each reduces the size to `MAX_ROUND_SIZE_RATIO` or less. The partitions stay unchanged if
    more than `MAX_SIZE_RATIO` of the size remains, or if the mesh has no faces.

    Args:
        recording: recording of the training.
        split: split of its poses; only training poses are evaluated.
        use_half_rotations: whether residuals are fitted to half-rotation matrices.
        tolerance_mm: as in `TrainingConfig`.
        last_hidden_units: number of units in the last hidden layer.
        should_stop: called before each partition is evaluated.

    Raises:
        Cancelled: `should_stop` returned True.
    """
    rig = recording.rig
    if len(recording.partitions) < 2 or not len(rig.face_starts):
        return recording.partitions
    tolerance = tolerance_mm / (1000 * rig.metres_per_unit)
    refinement = _Refinement(recording, split, use_half_rotations, tolerance, last_hidden_units + 1)
    bases, partition_by_vertex = refinement.bases(), refinement.partition_by_vertex
    initial_size = best_size = bases.parameter_count
    for _ in range(MAX_ROUNDS):
        refinement.reassign(bases, should_stop)
        bases = refinement.bases()
        if bases.parameter_count >= MAX_ROUND_SIZE_RATIO * best_size:
            break
        best_size, partition_by_vertex = bases.parameter_count, refinement.partition_by_vertex
    if best_size < MAX_SIZE_RATIO * initial_size:
        return reassign_vertices(recording.partitions, partition_by_vertex)
    return recording.partitions


def reassign_vertices(partitions: tuple[Partition, ...], partition_by_vertex: np.ndarray) -> tuple[Partition, ...]:
    """Return the partitions with reassigned vertices; `partition_by_vertex` has (V,) partition indices."""
    return tuple(
        replace(partition, vertices=np.flatnonzero(partition_by_vertex == index).astype(np.int32))
        for index, partition in enumerate(partitions)
    )


def partition_indices(partitions: tuple[Partition, ...]) -> np.ndarray:
    """Return (V,) int64, the partition index of each vertex."""
    partition_by_vertex = np.empty(sum(len(partition.vertices) for partition in partitions), np.int64)
    for index, partition in enumerate(partitions):
        partition_by_vertex[partition.vertices] = index
    return partition_by_vertex
