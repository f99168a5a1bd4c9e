# SPDX-License-Identifier: GPL-3.0-or-later
"""Graph nodes that compute the positions: each partition, or group of small partitions, takes one matrix product."""

from dataclasses import dataclass

import numpy as np

from fdda_addon.core.model import CONFIDENCE_OUTPUT, POSITIONS_OUTPUT
from fdda_addon.core.skinning import SkinBlock

from ..graph_builder import GraphBuilder
from ..inputs.block import MATRIX_COLUMNS, VECTOR_SIZE
from ..model import TrainedModel
from .network_nodes import Coefficients
from .pose_nodes import Features
from .vertex_order import vertex_order

MAX_PADDING_ELEMENTS = 6_000
"""Maximum number of zeros in a matrix of several partitions. Reading more takes longer than one more product."""
LINEAR_PART_SIZE = 3 * VECTOR_SIZE
"""Number of elements of a matrix's linear part, its first three columns. Matrices are stored column by column.

The linear part is gathered as one slice, because gathering takes the same time for short and for long slices. For the
same reason, translations are gathered in slices of three."""


@dataclass(frozen=True)
class _RowLayout:
    """The rows of a partition's matrix: three per component and half rotation, four per joint, and padding.

    Attributes:
        component_count: K.
        half_rotation_joints: joints with half-rotation matrices in the partition's fit, as in `JointFit`.
        joints: the joints of the partition's skin weights, followed by the joints of its fit.
        skin_joint_count: number of joints of the skin weights.
    """

    component_count: int
    half_rotation_joints: tuple[int, ...]
    joints: tuple[int, ...]
    skin_joint_count: int

    @property
    def padding(self) -> int:
        """Number of zero rows at the end, which fill the last slice of three translations."""
        return -len(self.joints) % 3

    @property
    def row_count(self) -> int:
        linear_only_count = self.component_count + len(self.half_rotation_joints)
        return 3 * linear_only_count + MATRIX_COLUMNS * len(self.joints) + self.padding

    def skin_mask(self) -> np.ndarray:
        """Return (row_count,) bool, which rows belong to the joints of the skin weights."""
        is_skin = np.arange(len(self.joints)) < self.skin_joint_count
        linear_only_rows = np.zeros(3 * (self.component_count + len(self.half_rotation_joints)), bool)
        padding_rows = np.zeros(self.padding, bool)
        return np.concatenate([linear_only_rows, np.repeat(is_skin, 3), is_skin, padding_rows])


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
    | each joint j with a half rotation | t Q_j A_j | B_j^-1 u_vj |
    | each joint j of the skin weights | P_j | w_vj B_j^-1 (x_v, 1) |
    | each joint j of the fit | t P_j | B_j^-1 u_vj, for m including the mean residual |

    The linear parts of all matrices come first, then the translations of the joints. Components and half rotations have
    no translation. In a large partition all constants except those of the skin joints are factorized (`low_rank`). The
    rows are then multiplied by a matrix with few columns first.

    Args:
        graph: graph to which the nodes are added.
        features: features in the graph, with the table of pose matrices.
        coefficients: coefficients of the networks, multiplied by the confidence; None without components.
        outside: name of the (N, 3 B') values that `add_range` returns. One of their elements is a constant 1.
        trained_model: model to export.
    """
    partitions = trained_model.partitions
    skins = [SkinBlock(trained_model.rig, partition) for partition in partitions]
    layouts = [_row_layout(trained_model, index, skin) for index, skin in enumerate(skins)]
    matrix_shapes = [
        (layout.row_count, len(partition.vertices)) for layout, partition in zip(layouts, partitions, strict=True)
    ]
    products = _group_products(matrix_shapes)
    ordered_partitions = [index for product in products for index in product]
    layouts = {index: layouts[index] for index in ordered_partitions}
    rows = _add_rows(graph, features, coefficients, outside, trained_model, layouts)
    row_counts = [sum(layouts[index].row_count for index in product) for product in products]
    row_blocks = graph.split(
        rows, row_counts, [f"rows_{product_index}" for product_index in range(len(products))], axis=2
    )
    order = vertex_order([partitions[index].vertices for index in ordered_partitions])
    column_order = dict(zip(ordered_partitions, order.columns, strict=True))
    position_blocks = [
        _add_product(graph, product_rows, f"{number}", product, trained_model, skins, layouts, column_order)
        for number, (product_rows, product) in enumerate(zip(row_blocks, products, strict=True))
    ]
    joined_positions = graph.join(position_blocks, "blocks", axis=2)
    joined_positions = graph.add("Transpose", [joined_positions], "positions_by_partition", perm=[0, 2, 1])
    order.add(graph, joined_positions, POSITIONS_OUTPUT)


def _add_product(
    graph: GraphBuilder,
    rows: str,
    suffix: str,
    product: list[int],
    trained_model: TrainedModel,
    skins: list[SkinBlock],
    layouts: dict[int, _RowLayout],
    column_order: dict[int, np.ndarray],
) -> str:
    """Add the product of rows with the matrices of the partitions of a product; returns the name of the positions."""
    matrices = [_partition_matrix(trained_model, index, skins[index], layouts[index]) for index in product]
    vertex_factors = trained_model.prepared[product[0]].vertex_factors
    if len(product) == 1 and vertex_factors is not None:
        left_factor, matrices[0] = _factorized_matrix(matrices[0], layouts[product[0]], vertex_factors)
        left_factor = graph.floats(f"left_factor_{suffix}", left_factor)
        rows = graph.add("MatMul", [rows, left_factor], f"low_rank_{suffix}")
    vertices = (trained_model.partitions[index].vertices for index in product)
    reordered = [
        _reorder_columns(matrix, vertices_of_matrix, column_order[index])
        for matrix, vertices_of_matrix, index in zip(matrices, vertices, product, strict=True)
    ]
    matrix = graph.floats(f"matrix_{suffix}", _block_diagonal(reordered))
    return graph.add("MatMul", [rows, matrix], f"block_{suffix}")


def _row_layout(trained_model: TrainedModel, index: int, skin: SkinBlock) -> _RowLayout:
    fit_joints, joint_count = trained_model.prepared[index].fit.joints, len(trained_model.rig.joints)
    joints = np.append(skin.joints, fit_joints[fit_joints < joint_count])
    return _RowLayout(
        trained_model.component_counts()[index],
        tuple(fit_joints[fit_joints >= joint_count].tolist()),
        tuple(joints.tolist()),
        len(skin.joints),
    )


def _add_rows(
    graph: GraphBuilder,
    features: Features,
    coefficients: Coefficients | None,
    outside: str,
    trained_model: TrainedModel,
    layouts: dict[int, _RowLayout],
) -> str:
    """Add the (N, 3, rows) rows of all partitions.

    Args:
        graph, features, coefficients, outside, trained_model: as in `add_skinning`.
        layouts: layout of each partition, by partition index, in the order of the products.
    """
    scaled_matrices, slice_order = _order_slices(features, coefficients, trained_model, layouts)
    joint_of_matrix, factor_of_matrix = zip(*scaled_matrices, strict=True)
    scalar_values = [outside, CONFIDENCE_OUTPUT, *([coefficients.name] if coefficients else [])]
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
    features: Features, coefficients: Coefficients | None, trained_model: TrainedModel, layouts: dict[int, _RowLayout]
) -> tuple[list[tuple[int, int]], list[int]]:
    """List the scaled matrices of all rows, and the order of their slices; arguments as in `_add_rows`.

    Returns:
        For each matrix its index in `Features.pose_rows`, and the index of its factor among the scalars. Then the order
        of the slices of nine elements: M linear parts, then M / 3 slices of translations.
    """
    # The scalars are `outside`, whose last element is the constant 1, then the confidence, then the coefficients.
    ones_index, confidence_start = VECTOR_SIZE * features.ones_vector, VECTOR_SIZE * (features.ones_vector + 1)
    scaled_matrices: list[tuple[int, int]] = []
    joint_starts = {}
    for index, layout in layouts.items():
        joint_starts[index] = len(scaled_matrices)
        scaled_matrices += [(joint, ones_index) for joint in layout.joints[: layout.skin_joint_count]]
        scaled_matrices += [(joint, confidence_start + index) for joint in layout.joints[layout.skin_joint_count :]]
        scaled_matrices += layout.padding * [(0, ones_index)]
    # Slices of translations have negative values here, because their offset is known only at the end.
    slice_order = []
    for index, layout in layouts.items():
        linear_start = len(scaled_matrices)
        if layout.component_count:
            first_coefficient = confidence_start + len(layouts) + coefficients.start_by_partition[index]
            main_joint = trained_model.partitions[index].joint
            scaled_matrices += [(main_joint, first_coefficient + k) for k in range(layout.component_count)]
        scaled_matrices += [(joint, confidence_start + index) for joint in layout.half_rotation_joints]
        joint_end = joint_starts[index] + len(layout.joints)
        slice_order += [*range(linear_start, len(scaled_matrices)), *range(joint_starts[index], joint_end)]
        slice_order += [~(matrix_index // 3) for matrix_index in range(joint_starts[index], joint_end, 3)]
    scaled_matrices += -len(scaled_matrices) % 3 * [(0, ones_index)]
    return scaled_matrices, [len(scaled_matrices) + ~i if i < 0 else i for i in slice_order]


def _group_products(matrix_shapes: list[tuple[int, int]]) -> list[list[int]]:
    """Group matrices into products: small matrices share a block-diagonal matrix as long as it has few zeros.

    Args:
        matrix_shapes: numbers of rows and columns of each matrix.

    Returns:
        Indices of the matrices of each product.
    """
    products: list[list[int]] = []
    row_count = column_count = 0
    for index in sorted(
        range(len(matrix_shapes)), key=lambda index: (matrix_shapes[index][0] * matrix_shapes[index][1], index)
    ):
        if (
            products
            and matrix_shapes[index][0] * column_count + matrix_shapes[index][1] * row_count < MAX_PADDING_ELEMENTS
        ):
            products[-1].append(index)
        else:
            products.append([index])
            row_count = column_count = 0
        row_count, column_count = row_count + matrix_shapes[index][0], column_count + matrix_shapes[index][1]
    return products


def _block_diagonal(matrices: list[np.ndarray]) -> np.ndarray:
    row_starts, column_starts = np.cumsum([(0, 0), *(matrix.shape for matrix in matrices)], axis=0).T
    joined = np.zeros((row_starts[-1], column_starts[-1]))
    for index, matrix in enumerate(matrices):
        joined[row_starts[index] : row_starts[index + 1], column_starts[index] : column_starts[index + 1]] = matrix
    return joined


def _reorder_columns(matrix: np.ndarray, vertices: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Reorder the columns of a matrix, one for each of `vertices`; `columns` has vertices, or -1 for a zero column."""
    return np.where(columns >= 0, matrix[:, np.searchsorted(vertices, np.maximum(columns, vertices[0]))], 0)


def _factorized_matrix(
    matrix: np.ndarray, layout: _RowLayout, vertex_factors: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Replace a partition's matrix by a product of two; the first leaves the rows of the skin joints unchanged."""
    is_skin = layout.skin_mask()
    skin_row_count, vertex_factors = is_skin.sum(), vertex_factors.astype(np.float64)
    left_factor = np.zeros((len(matrix), skin_row_count + len(vertex_factors)))
    left_factor[is_skin, :skin_row_count] = np.eye(skin_row_count)
    left_factor[~is_skin, skin_row_count:] = matrix[~is_skin] @ vertex_factors.T
    return left_factor, np.concatenate([matrix[is_skin], vertex_factors])


def _partition_matrix(trained_model: TrainedModel, index: int, skin: SkinBlock, layout: _RowLayout) -> np.ndarray:
    """Compute the (rows, Vp) float64 constant matrix of a partition."""
    inverse_rest = np.linalg.inv(trained_model.rig.rest_matrices.astype(np.float64))
    partition, prepared = trained_model.partitions[index], trained_model.prepared[index]
    basis, fit = prepared.basis, prepared.fit
    vertex_count = len(partition.vertices)
    weighted_rest = skin.weighted_rest.reshape(len(skin.joints), 4, -1).astype(np.float64)
    fit_factors = fit.factors.reshape(-1, 4, vertex_count).astype(np.float64)
    mean = basis.mean.astype(np.float64)
    if layout.component_count:
        # The last bias of the network is a constant residual.
        mean = mean + trained_model.networks[index].biases[-1].astype(np.float64) @ basis.components
    fit_factors[np.flatnonzero(fit.joints == partition.joint), :3] += mean.reshape(vertex_count, 3).T
    fit_rows = inverse_rest[fit.joints % len(inverse_rest)] @ fit_factors
    has_translation = fit.joints < len(inverse_rest)
    component_rows = basis.components.reshape(-1, vertex_count, 3)
    component_rows = np.einsum("ab,kvb->kav", inverse_rest[partition.joint, :3, :3], component_rows)
    joint_rows = np.concatenate([inverse_rest[skin.joints] @ weighted_rest, fit_rows[has_translation]])
    padding_rows = np.zeros((layout.padding, vertex_count))
    row_blocks = [
        component_rows,
        fit_rows[~has_translation, :3],
        joint_rows[:, :3],
        joint_rows[:, 3],
        padding_rows,
    ]
    return np.concatenate([rows.reshape(-1, vertex_count) for rows in row_blocks])
