# SPDX-License-Identifier: GPL-3.0-or-later
"""Graph nodes that compute the positions: each partition takes one matrix product."""

from dataclasses import dataclass

import numpy as np

from fdda_addon.core.formats.model import CONFIDENCE_OUTPUT, CONTROLS_INPUT, POSITIONS_OUTPUT
from fdda_addon.core.mathematics.skinning import SkinBlock

from ..graph_builder import GraphBuilder
from ..inputs.block import MATRIX_COLUMNS, VECTOR_SIZE
from ..model import TrainedModel
from .network_nodes import Coefficients
from .pose_nodes import Features

BLOCK_SIZE = 16
"""Number of vertices per block of a large mesh."""
MIN_BLOCK_VERTICES = 20_000
"""Blocks are used from this number of vertices on, if most vertices lie in whole blocks. In smaller meshes the
additional nodes take longer than they save: docs/experiments.md, What each mechanism brings."""
LINEAR_PART_SIZE = 3 * VECTOR_SIZE
"""Number of elements of a matrix's linear part, its first three columns. Matrices are stored column by column.

The linear part is gathered as one slice, because gathering takes the same time for short and for long slices. For the
same reason, translations are gathered in slices of three."""


@dataclass(frozen=True)
class VertexOrder:
    """The order of the vertices in the products.

    Attributes:
        block_size: number of vertices per block.
        columns: for each partition, the vertex index of each of its columns; -1 for padding.
        vertex_count: V, number of vertices of the mesh.
    """

    block_size: int
    columns: tuple[np.ndarray, ...]
    vertex_count: int

    def add(self, graph: GraphBuilder, ordered_positions: str, output_name: str) -> None:
        """Add nodes that reorder (N, ·, 3) positions from the order of the columns to that of the mesh, (N, V, 3)."""
        all_columns, block_size = np.concatenate(self.columns), self.block_size
        column_of_vertex = np.zeros(-(-self.vertex_count // block_size) * block_size, np.int64)
        column_of_vertex[all_columns[all_columns >= 0]] = np.flatnonzero(all_columns >= 0)
        if block_size == 1:
            order = graph.short_integers("vertex_order", column_of_vertex)
            graph.add("Gather", [ordered_positions, order], output_name, axis=1)
            return
        is_padded = len(column_of_vertex) > self.vertex_count
        blocks = column_of_vertex.reshape(-1, block_size)
        is_whole = (blocks[:, 0] % block_size == 0) & (np.diff(blocks, axis=1) == 1).all(axis=1)
        is_whole[-1] &= not is_padded
        mixed_order = len(all_columns) // block_size + np.cumsum(~is_whole) - 1
        block_order = np.where(is_whole, blocks[:, 0] // block_size, mixed_order)
        vertex_blocks = graph.reshape(ordered_positions, [0, -1, 3 * block_size], "vertex_blocks")
        if not is_whole.all():
            mixed_blocks = graph.short_integers("mixed_vertices", blocks[~is_whole].ravel())
            mixed_blocks = graph.add("Gather", [ordered_positions, mixed_blocks], "mixed_positions", axis=1)
            mixed_blocks = graph.reshape(mixed_blocks, [0, -1, 3 * block_size], "mixed_blocks")
            vertex_blocks = graph.add("Concat", [vertex_blocks, mixed_blocks], "all_blocks", axis=1)
        order = graph.short_integers("block_order", block_order)
        vertex_blocks = graph.add("Gather", [vertex_blocks, order], "blocks_in_order", axis=1)
        shape = [0, len(column_of_vertex), 3]
        padded_positions = graph.reshape(vertex_blocks, shape, "padded_positions" if is_padded else output_name)
        if is_padded:
            graph.slice(padded_positions, 0, self.vertex_count, 1, output_name)


def vertex_order(vertices_of_partitions: list[np.ndarray]) -> VertexOrder:
    """Choose the block size. Each partition has its vertices in whole blocks first.

    Args:
        vertices_of_partitions: (Vp,) vertex indices of each partition, ascending.
    """
    vertex_count = sum(len(vertices) for vertices in vertices_of_partitions)
    partition_by_vertex = np.empty(vertex_count, np.int64)
    for index, vertices in enumerate(vertices_of_partitions):
        partition_by_vertex[vertices] = index
    is_whole, columns = _is_in_whole_block(partition_by_vertex, BLOCK_SIZE), []
    block_size = BLOCK_SIZE if vertex_count >= MIN_BLOCK_VERTICES and is_whole.mean() > 0.5 else 1
    for vertices in vertices_of_partitions:
        padding = np.full(-len(vertices) % block_size, -1)
        columns.append(np.concatenate([vertices[is_whole[vertices]], vertices[~is_whole[vertices]], padding]))
    return VertexOrder(block_size, tuple(columns), vertex_count)


def _is_in_whole_block(partition_by_vertex: np.ndarray, block_size: int) -> np.ndarray:
    """Return (V,) bool, which vertices lie in a block of adjacent indices that all have the same partition."""
    padding = np.full(-len(partition_by_vertex) % block_size, -1)
    blocks = np.append(partition_by_vertex, padding).reshape(-1, block_size)
    return np.repeat((blocks == blocks[:, :1]).all(axis=1), block_size)[: len(partition_by_vertex)]


class _PartitionRows:
    """The rows of a part: three for each component, shape key and half rotation, four for each joint, and padding.

    Attributes:
        index, joint, vertices: index, main joint and (Vp,) vertices of the part.
        partition_index: index of its partition.
        prepared, skin: its fit and components, and its skin weights.
        component_count: K.
        controls: (S,) the shape keys of its fit.
        half_rotation_joints: joints with half-rotation matrices in the partition's fit, as in `JointFit`.
        joints: the joints of the partition's skin weights, followed by the joints of its fit.
        padding: number of zero rows at the end, which fill the last slice of three translations.
        linear_only_count: number of the first rows, those of components, shape keys and half rotations.
        row_count: number of rows.
    """

    def __init__(self, trained_model: TrainedModel, index: int):
        """Lay out the rows of the partition with this index."""
        part, self._rig = trained_model.parts[index], trained_model.rig
        self.index, self.partition_index = index, trained_model.partition_indices()[index]
        self.prepared = trained_model.prepared[index]
        self.joint, self.vertices = part.joint, part.vertices
        self.skin = SkinBlock(self._rig, self.joint, self.vertices)
        is_half_rotation = self.prepared.fit.joints >= len(self._rig.joints)
        self.component_count = len(self.prepared.basis.components)
        self.controls = self.prepared.fit.controls
        self.half_rotation_joints = self.prepared.fit.joints[is_half_rotation]
        self.joints = np.append(self.skin.joints, self.prepared.fit.joints[~is_half_rotation])
        self.padding = -len(self.joints) % 3
        self.linear_only_count = 3 * (self.component_count + len(self.controls) + len(self.half_rotation_joints))
        self.row_count = self.linear_only_count + MATRIX_COLUMNS * len(self.joints) + self.padding

    def matrix(self) -> np.ndarray:
        """Compute the (row_count, Vp) float64 constant matrix."""
        inverse_rest = np.linalg.inv(self._rig.rest_matrices.astype(np.float64))
        basis, fit, vertex_count = self.prepared.basis, self.prepared.fit, len(self.vertices)
        weighted_rest = self.skin.weighted_rest.reshape(len(self.skin.joints), 4, -1).astype(np.float64)
        fit_factors = fit.factors.reshape(-1, 4, vertex_count).astype(np.float64)
        mean = basis.mean.astype(np.float64)
        if self.component_count:
            # The last bias of the network is a constant residual.
            mean = mean + self.prepared.network.biases[-1].astype(np.float64) @ basis.components
        fit_factors[np.flatnonzero(fit.joints == self.joint), :3] += mean.reshape(vertex_count, 3).T
        fit_rows = inverse_rest[fit.joints % len(inverse_rest)] @ fit_factors
        has_translation = fit.joints < len(inverse_rest)
        component_rows = basis.components.reshape(-1, vertex_count, 3)
        component_rows = np.einsum("ab,kvb->kav", inverse_rest[self.joint, :3, :3], component_rows)
        key_rows = fit.control_factors.reshape(len(self.controls), 3, vertex_count)
        key_rows = np.einsum("ab,kbv->kav", inverse_rest[self.joint, :3, :3], key_rows)
        joint_rows = np.concatenate([inverse_rest[self.skin.joints] @ weighted_rest, fit_rows[has_translation]])
        padding_rows = np.zeros((self.padding, vertex_count))
        linear_rows = [component_rows, key_rows, fit_rows[~has_translation, :3], joint_rows[:, :3]]
        row_blocks = [*linear_rows, joint_rows[:, 3], padding_rows]
        return np.concatenate([rows.reshape(-1, vertex_count) for rows in row_blocks])

    def factorized_matrix(self) -> tuple[np.ndarray, np.ndarray]:
        """Return two factors of the constant matrix; the first leaves the rows of the skin joints unchanged."""
        is_skin_joint = np.arange(len(self.joints)) < len(self.skin.joints)
        is_skin = np.zeros(self.row_count, bool)
        is_skin[self.linear_only_count : self.row_count - self.padding] = np.append(
            np.repeat(is_skin_joint, 3), is_skin_joint
        )
        matrix, skin_row_count = self.matrix(), is_skin.sum()
        vertex_factors = self.prepared.vertex_factors.astype(np.float64)
        left_factor = np.zeros((self.row_count, skin_row_count + len(vertex_factors)))
        left_factor[is_skin, len(vertex_factors) :] = np.eye(skin_row_count)
        left_factor[~is_skin, : len(vertex_factors)] = matrix[~is_skin] @ vertex_factors.T
        return left_factor, np.concatenate([vertex_factors, matrix[is_skin]])


def add_skinning(
    graph: GraphBuilder,
    features: Features,
    coefficients: Coefficients | None,
    outside: str,
    trained_model: TrainedModel,
) -> None:
    """Add the nodes from the coefficients to the output `positions`.

    The positions of a partition are the product of its rows, which depend on the pose, and a constant matrix. With the
    confidence t of the partition and its main joint m, rows and constants are:

    | element | rows | constants |
    |---|---|---|
    | each component k | t c_k P_m | the component, rotated by B_m^-1 |
    | each shape key k | s_k P_m | e_kv, rotated by B_m^-1 |
    | each joint j with a half rotation | t Q_j A_j | B_j^-1 u_vj |
    | each joint j of the skin weights | P_j | w_vj B_j^-1 (x_v, 1) |
    | each joint j of the fit | t P_j | B_j^-1 u_vj, for m including the mean residual |

    The linear parts of all matrices come first, then the translations of the joints. Components and half rotations have
    no translation. In a large partition all constants except those of the skin joints are factorized (`low_rank`). The
    rows are then multiplied by a matrix with few columns first.

    Args:
        features: features in the graph, with the table of pose matrices.
        coefficients: coefficients of the networks, multiplied by the confidence; None without components.
        outside: name of the (N, 3 B') values that `add_range` returns. One of their elements is a constant 1.
    """
    partitions = [_PartitionRows(trained_model, index) for index in range(len(trained_model.parts))]
    rows = _add_rows(graph, features, coefficients, outside, partitions, trained_model)
    row_counts, names = [p.row_count for p in partitions], [f"rows_{p.index}" for p in partitions]
    row_blocks = graph.split(rows, row_counts, names, axis=2)
    order = vertex_order([partition.vertices for partition in partitions])
    position_blocks = [
        _add_product(graph, *arguments) for arguments in zip(row_blocks, partitions, order.columns, strict=True)
    ]
    joined_positions = graph.join(position_blocks, "blocks", axis=2)
    joined_positions = graph.add("Transpose", [joined_positions], "positions_by_partition", perm=[0, 2, 1])
    order.add(graph, joined_positions, POSITIONS_OUTPUT)


def _add_product(graph: GraphBuilder, rows: str, partition: _PartitionRows, columns: np.ndarray) -> str:
    """Add the product of the (N, 3, rows) rows of a partition with its matrix.

    Args:
        columns: the vertex of each column of its positions; -1 for a column of zeros.

    Returns:
        Name of the (N, 3, columns) positions.
    """
    suffix = partition.index
    if partition.prepared.vertex_factors is None:
        matrix, compact_count = partition.matrix(), partition.linear_only_count
    else:
        left_factor, matrix = partition.factorized_matrix()
        left_factor = _add_matrix(graph, f"left_factor_{suffix}", left_factor, partition.linear_only_count)
        rows = graph.add("MatMul", [rows, left_factor], f"low_rank_{suffix}")
        compact_count = len(partition.prepared.vertex_factors)
    # Each of the partition's vertices has a column of the matrix.
    vertices = partition.vertices
    indices = np.searchsorted(vertices, np.maximum(columns, vertices[0]))
    matrix = np.where(columns >= 0, matrix[:, indices], 0)
    return graph.add("MatMul", [rows, _add_matrix(graph, f"matrix_{suffix}", matrix, compact_count)], f"block_{suffix}")


def _add_matrix(graph: GraphBuilder, name: str, matrix: np.ndarray, compact_count: int) -> str:
    """Add a constant matrix whose first rows are stored as 16-bit integers.

    The rows of joints that have a translation are exact: an error would grow with the distance from the origin.
    """
    parts = [graph.compact_floats(f"{name}_compact", matrix[:compact_count])] if compact_count else []
    if compact_count < len(matrix):
        parts.append(graph.floats(f"{name}_exact", matrix[compact_count:]))
    return graph.join(parts, name, axis=0)


def _add_rows(
    graph: GraphBuilder,
    features: Features,
    coefficients: Coefficients | None,
    outside: str,
    partitions: list[_PartitionRows],
    trained_model: TrainedModel,
) -> str:
    """Add the (N, 3, rows) rows of all parts; other arguments as in `add_skinning`."""
    scaled_matrices, slice_order = _order_slices(features, coefficients, partitions, trained_model)
    joint_of_matrix, factor_of_matrix = zip(*scaled_matrices, strict=True)
    scalar_values = [outside, CONFIDENCE_OUTPUT, *([coefficients.name] if coefficients else [])]
    if any(len(partition.controls) for partition in partitions):
        scalar_values.insert(0, CONTROLS_INPUT)
    factors = graph.integers("row_factors", np.array(factor_of_matrix)[:, None])
    factors = graph.add("Gather", [graph.join(scalar_values, "scalars", axis=1), factors], "factors", axis=1)
    # A product repeats each factor twelve times: broadcasting the multiplication takes three times as long.
    factors = graph.add("MatMul", [factors, graph.floats("twelve_ones", np.ones((1, 12)))], "factors_of_poses")
    matrices = graph.integers("row_poses", features.pose_rows[list(joint_of_matrix)])
    matrices = graph.add("Gather", [features.table, matrices], "unscaled", axis=1)
    matrices = graph.add("Mul", [matrices, factors], "scaled")
    linear_parts, translations = graph.split(
        matrices, [LINEAR_PART_SIZE, VECTOR_SIZE], ["linear_parts", "translations"], axis=2
    )
    translations = graph.reshape(translations, [0, -1, LINEAR_PART_SIZE], "translations_by_three")
    rows = graph.add("Concat", [linear_parts, translations], "row_slices", axis=1)
    rows = graph.add("Gather", [rows, graph.integers("row_slice_order", slice_order)], "ordered_slices", axis=1)
    rows = graph.reshape(rows, [0, 3 * len(slice_order), VECTOR_SIZE], "rows")
    return graph.add("Transpose", [rows], "rows_by_axis", perm=[0, 2, 1])


def _order_slices(
    features: Features, coefficients: Coefficients | None, partitions: list[_PartitionRows], trained_model: TrainedModel
) -> tuple[list[tuple[int, int]], list[int]]:
    """List the scaled matrices of all rows, and the order of their slices; arguments as in `_add_rows`.

    Returns:
        For each matrix its index in `Features.pose_rows`, and the index of its factor among the scalars. Then the order
        of the slices of nine elements: M linear parts, then M / 3 slices of translations.
    """
    # The scalars are the controls, if there are keys, then `outside`, whose last element is the constant 1, then the
    # confidence, then the coefficients.
    has_keys = any(len(partition.controls) for partition in partitions)
    control_count = len(trained_model.rig.controls) if has_keys else 0
    partition_count = len(trained_model.partitions)
    ones_index = control_count + VECTOR_SIZE * features.ones_vector
    confidence_start = ones_index + VECTOR_SIZE
    scaled_matrices: list[tuple[int, int]] = []
    joint_starts = []
    for partition in partitions:
        joint_starts.append(len(scaled_matrices))
        skin_joints, fit_joints = np.split(partition.joints, [len(partition.skin.joints)])
        scaled_matrices += [(joint, ones_index) for joint in skin_joints]
        scaled_matrices += [(joint, confidence_start + partition.partition_index) for joint in fit_joints]
        scaled_matrices += partition.padding * [(0, ones_index)]
    # Slices of translations have negative values here, because their offset is known only at the end.
    slice_order = []
    for partition, joint_start in zip(partitions, joint_starts, strict=True):
        linear_start, joint_end = len(scaled_matrices), joint_start + len(partition.joints)
        if partition.component_count:
            first_coefficient = confidence_start + partition_count + coefficients.start_by_part[partition.index]
            scaled_matrices += [(partition.joint, first_coefficient + k) for k in range(partition.component_count)]
        scaled_matrices += [(partition.joint, control) for control in partition.controls]
        scaled_matrices += [
            (joint, confidence_start + partition.partition_index) for joint in partition.half_rotation_joints
        ]
        slice_order += [*range(linear_start, len(scaled_matrices)), *range(joint_start, joint_end)]
        slice_order += [~(matrix_index // 3) for matrix_index in range(joint_start, joint_end, 3)]
    scaled_matrices += -len(scaled_matrices) % 3 * [(0, ones_index)]
    return scaled_matrices, [len(scaled_matrices) + ~i if i < 0 else i for i in slice_order]
