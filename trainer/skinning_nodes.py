# SPDX-License-Identifier: GPL-3.0-or-later
"""Graph nodes that compute the positions: one product with a constant matrix for each partition or small group."""

from dataclasses import dataclass, replace

import numpy as np

from fdda_addon.core.model import CONFIDENCE_OUTPUT, POSITIONS_OUTPUT
from fdda_addon.core.skinning import SkinBlock

from .graph_builder import GraphBuilder
from .network_nodes import Coefficients
from .pose_nodes import COLUMNS, VECTOR, Features
from .trained_model import TrainedModel
from .vertex_order import vertex_order

MAX_PADDING_ELEMENTS = 6_000
"""Reading more zeros than this in the matrix of several partitions takes longer than one more product."""
LINEAR_PART = 3 * VECTOR
"""Elements of the linear part of a matrix that is stored column by column: the first three columns. They are gathered
together, as gathering takes the same time for each slice whatever its length. Translations are gathered three at a
time, for the same reason."""


@dataclass(frozen=True)
class _RowLayout:
    """The rows of a partition's matrix: three per component and half rotation, four per joint, and padding.

    Attributes:
        component_count: K.
        half_rotation_joints: joints whose half-rotation matrices it is fitted to, as in `JointFit`.
        joints: the joints of its skin weights, followed by the joints of its fit.
        skin_joint_count: number of joints of its skin weights.
        leading: number of joints whose translations come first, gathered with the last ones of the partition before.
        padding: zero rows at the end.
    """

    component_count: int
    half_rotation_joints: tuple[int, ...]
    joints: tuple[int, ...]
    skin_joint_count: int
    leading: int = 0
    padding: int = 0

    @property
    def size(self) -> int:
        linear_only = self.component_count + len(self.half_rotation_joints)
        return 3 * linear_only + COLUMNS * len(self.joints) + self.padding

    def skin_mask(self) -> np.ndarray:
        """Return (size,) bool, which rows are of the joints of the skin weights."""
        is_skin = np.arange(len(self.joints)) < self.skin_joint_count
        leading, trailing = np.split(is_skin, [self.leading])
        linear_only = np.zeros(3 * (self.component_count + len(self.half_rotation_joints)), bool)
        padding = np.zeros(self.padding, bool)
        return np.concatenate([leading, linear_only, np.repeat(is_skin, 3), trailing, padding])


def add_skinning(
    graph: GraphBuilder,
    features: Features,
    coefficients: Coefficients | None,
    outside: str,
    trained_model: TrainedModel,
) -> None:
    """Add the nodes from the coefficients to the output `positions`.

    With t the confidence of partition p and m its main joint, the rows of p are made of the matrices
    [ t c_k P_m | t Q_j A_j of the joints j of its half rotations | P_j of its skin joints | t P_j of its fit's joints
    ]. In this order: translations of the `leading` joints, linear parts of all matrices, translations of the other
    joints. Components and half rotations have no translation. The constant matrix has in the same order [ components
    rotated by B_m^-1 | B_j^-1 u_vj | w_vj B_j^-1 (x_v, 1) | B_j^-1 u_vj, for m with the mean ]: the inverse rest
    matrices are in the constants. In a large partition everything but the skin joints is factorized (`low_rank`), and a
    matrix with few columns comes first.

    Args:
        graph: to add the nodes to.
        features: with the pose matrices.
        coefficients: of the networks times the confidence, if there are any.
        outside: name of (N, 3 B'), as from `add_range`; one of its elements is a constant 1.
        trained_model: to export.
    """
    partitions = trained_model.partitions
    skins = [SkinBlock(trained_model.rig, partition) for partition in partitions]
    layouts = [_row_layout(trained_model, index, skin) for index, skin in enumerate(skins)]
    sizes = [(layout.size, len(partition.vertices)) for layout, partition in zip(layouts, partitions, strict=True)]
    products = _group_products(sizes)
    ordered = [index for product in products for index in product]
    layouts = dict(zip(ordered, _pack_translations([layouts[index] for index in ordered]), strict=True))
    slices, slice_order = _add_row_slices(graph, features, coefficients, outside, trained_model, layouts)
    gathered = graph.add("Gather", [slices, graph.integers("row_slice_order", slice_order)], "ordered_slices", axis=1)
    gathered = graph.reshape(gathered, [0, 3 * len(slice_order), VECTOR], "rows")
    gathered = graph.add("Transpose", [gathered], "rows_by_axis", perm=[0, 2, 1])
    lengths = [sum(layouts[index].size for index in product) for product in products]
    row_blocks = graph.split(gathered, lengths, [f"rows_{number}" for number in range(len(products))], axis=2)
    order = vertex_order([partitions[index].vertices for index in ordered])
    columns = dict(zip(ordered, order.columns, strict=True))
    blocks = []
    for number, (rows, product) in enumerate(zip(row_blocks, products, strict=True)):
        matrices = [_partition_matrix(trained_model, index, skins[index], layouts[index]) for index in product]
        vertex_factors = trained_model.prepared[product[0]].vertex_factors
        if len(product) == 1 and vertex_factors is not None:
            left_factor, matrices[0] = _factorized_matrix(matrices[0], layouts[product[0]], vertex_factors)
            left_factor = graph.floats(f"left_factor_{number}", left_factor)
            rows = graph.add("MatMul", [rows, left_factor], f"low_rank_{number}")
        for slot, index in enumerate(product):
            matrices[slot] = _reorder_columns(matrices[slot], partitions[index].vertices, columns[index])
        matrix = graph.floats(f"matrix_{number}", _block_diagonal(matrices))
        blocks.append(graph.add("MatMul", [rows, matrix], f"block_{number}"))
    joined = graph.join(blocks, "blocks", axis=2)
    joined = graph.add("Transpose", [joined], "positions_by_partition", perm=[0, 2, 1])
    order.add(graph, joined, POSITIONS_OUTPUT)


def _row_layout(trained_model: TrainedModel, index: int, skin: SkinBlock) -> _RowLayout:
    fit_joints, joint_count = trained_model.prepared[index].fit.joints, len(trained_model.rig.joints)
    joints = np.append(skin.joints, fit_joints[fit_joints < joint_count])
    return _RowLayout(
        trained_model.component_counts()[index],
        tuple(fit_joints[fit_joints >= joint_count].tolist()),
        tuple(joints.tolist()),
        len(skin.joints),
    )


def _pack_translations(layouts: list[_RowLayout]) -> list[_RowLayout]:
    """Pack translations in threes: the last of a partition share a slice with the first of the next one."""
    packed, leading = [], 0
    for index, layout in enumerate(layouts):
        missing = (leading - len(layout.joints)) % 3
        is_shared = index + 1 < len(layouts) and missing <= len(layouts[index + 1].joints)
        packed.append(replace(layout, leading=leading, padding=0 if is_shared else missing))
        leading = missing if is_shared else 0
    return packed


def _add_row_slices(
    graph: GraphBuilder,
    features: Features,
    coefficients: Coefficients | None,
    outside: str,
    trained_model: TrainedModel,
    layouts: dict[int, _RowLayout],
) -> tuple[str, list[int]]:
    """Add the scaled matrices that the rows of all partitions are made of, in slices of nine elements.

    Args:
        layouts: by partition index, in the order of the products; the others as in `add_skinning`.

    Returns:
        Name of the (N, ·, 9) slices, and the order in which the rows take them.
    """
    # The constant 1 is the last element of `outside`, directly before the confidence; the coefficients follow.
    one, confidence = VECTOR * features.one, VECTOR * (features.one + 1)
    # Pairs of the index of a matrix and the index of its factor among the scalars.
    terms: list[tuple[int, int]] = []
    starts = {}
    for index, layout in layouts.items():
        starts[index] = len(terms)
        terms += [(joint, one) for joint in layout.joints[: layout.skin_joint_count]]
        terms += [(joint, confidence + index) for joint in layout.joints[layout.skin_joint_count :]]
        terms += layout.padding * [(0, one)]
    # Negative values are slices of translations, whose offset is known only at the end.
    order = []
    for index, layout in layouts.items():
        linear_start = len(terms)
        if layout.component_count:
            first = confidence + len(layouts) + coefficients.first[index]
            main_joint = trained_model.partitions[index].joint
            terms += [(main_joint, first + component) for component in range(layout.component_count)]
        terms += [(joint, confidence + index) for joint in layout.half_rotation_joints]
        end = starts[index] + len(layout.joints)
        order += [*range(linear_start, len(terms)), *range(starts[index], end)]
        order += [~(term // 3) for term in range(starts[index] + layout.leading, end, 3)]
    terms += -len(terms) % 3 * [(0, one)]
    order = [len(terms) + ~position if position < 0 else position for position in order]
    joints, factors = zip(*terms, strict=True)
    scalars = [outside, CONFIDENCE_OUTPUT, *([coefficients.name] if coefficients else [])]
    scale = graph.integers("row_factors", np.array(factors)[:, None])
    scale = graph.add("Gather", [graph.join(scalars, "scalars", axis=1), scale], "factors", axis=1)
    # A product repeats each factor twelve times: broadcasting the multiplication takes three times as long.
    scale = graph.add("MatMul", [scale, graph.floats("twelve_ones", np.ones((1, 12)))], "factors_of_poses")
    poses = graph.integers("row_poses", features.pose_rows[list(joints)])
    poses = graph.add("Gather", [features.table, poses], "unscaled", axis=1)
    poses = graph.add("Mul", [poses, scale], "scaled")
    linear, translations = graph.split(poses, [LINEAR_PART, VECTOR], ["linear_parts", "translations"], axis=2)
    translations = graph.reshape(translations, [0, -1, LINEAR_PART], "translations_by_three")
    return graph.add("Concat", [linear, translations], "row_slices", axis=1), order


def _group_products(sizes: list[tuple[int, int]]) -> list[list[int]]:
    """Group matrices into products: small matrices share a block-diagonal one while it has few zeros.

    Args:
        sizes: number of rows and columns of each matrix.

    Returns:
        Indices of the matrices of each product.
    """
    products: list[list[int]] = []
    rows = columns = 0
    for index in sorted(range(len(sizes)), key=lambda index: (sizes[index][0] * sizes[index][1], index)):
        if products and sizes[index][0] * columns + sizes[index][1] * rows < MAX_PADDING_ELEMENTS:
            products[-1].append(index)
        else:
            products.append([index])
            rows = columns = 0
        rows, columns = rows + sizes[index][0], columns + sizes[index][1]
    return products


def _block_diagonal(matrices: list[np.ndarray]) -> np.ndarray:
    rows, columns = np.cumsum([(0, 0), *(matrix.shape for matrix in matrices)], axis=0).T
    joined = np.zeros((rows[-1], columns[-1]))
    for index, matrix in enumerate(matrices):
        joined[rows[index] : rows[index + 1], columns[index] : columns[index + 1]] = matrix
    return joined


def _reorder_columns(matrix: np.ndarray, vertices: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Reorder the columns of a matrix of some vertices; `columns` are vertices, or -1 for zeros."""
    return np.where(columns >= 0, matrix[:, np.searchsorted(vertices, np.maximum(columns, vertices[0]))], 0)


def _factorized_matrix(
    matrix: np.ndarray, layout: _RowLayout, vertex_factors: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Replace a partition's matrix by a product of two; the first passes the rows of the skin joints unchanged."""
    is_skin = layout.skin_mask()
    count, vertex_factors = is_skin.sum(), vertex_factors.astype(np.float64)
    left_factor = np.zeros((len(matrix), count + len(vertex_factors)))
    left_factor[is_skin, :count] = np.eye(count)
    left_factor[~is_skin, count:] = matrix[~is_skin] @ vertex_factors.T
    return left_factor, np.concatenate([matrix[is_skin], vertex_factors])


def _partition_matrix(trained_model: TrainedModel, index: int, skin: SkinBlock, layout: _RowLayout) -> np.ndarray:
    """Compute the (rows, Vp) float64 constant matrix of a partition."""
    inverse_rest = np.linalg.inv(trained_model.rig.rest_matrices.astype(np.float64))
    partition, prepared = trained_model.partitions[index], trained_model.prepared[index]
    basis, fit = prepared.basis, prepared.fit
    count = len(partition.vertices)
    weighted_rest = skin.weighted_rest.reshape(len(skin.joints), 4, -1).astype(np.float64)
    factors = fit.factors.reshape(-1, 4, count).astype(np.float64)
    mean = basis.mean.astype(np.float64)
    if layout.component_count:
        # The last bias of the network is a constant residual.
        mean = mean + trained_model.networks[index].biases[-1].astype(np.float64) @ basis.components
    factors[np.flatnonzero(fit.joints == partition.joint), :3] += mean.reshape(count, 3).T
    fitted = inverse_rest[fit.joints % len(inverse_rest)] @ factors
    has_translation = fit.joints < len(inverse_rest)
    components = basis.components.reshape(-1, count, 3)
    components = np.einsum("ab,kvb->kav", inverse_rest[partition.joint, :3, :3], components)
    joints = np.concatenate([inverse_rest[skin.joints] @ weighted_rest, fitted[has_translation]])
    leading, trailing = np.split(joints[:, 3], [layout.leading])
    padding = np.zeros((layout.padding, count))
    parts = [leading, components, fitted[~has_translation, :3], joints[:, :3], trailing, padding]
    return np.concatenate([part.reshape(-1, count) for part in parts])
