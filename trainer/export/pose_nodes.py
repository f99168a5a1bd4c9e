# SPDX-License-Identifier: GPL-3.0-or-later
"""Graph nodes that compute the features of a pose, clamp them to the training range, and compute the confidence.

The graph computes features of joints as vectors R^-1 (d - t) of three elements, where R and t are the axes and the
translation of a space. A vector is a column of a joint's matrix, in the space of the joint as its reference joint
carries it along. All vectors together take one gather of spaces, two gathers of points, and one product.

Half-rotation matrices and the features of rotations are computed from the same vectors.
"""

from dataclasses import dataclass

import numpy as np

from fdda_addon.core.formats.model import CONFIDENCE_OUTPUT, POSE_INPUT
from fdda_addon.core.mathematics.features import FEATURES_PER_JOINT
from fdda_addon.core.rig import Rig

from ..fits.half_rotations import MIN_DIVISOR
from ..graph_builder import GraphBuilder
from ..inputs.block import MATRIX_COLUMNS, VECTOR_SIZE, JointVectors
from ..model import TrainedModel

ZERO_ROW, MATRIX_ROW, ROWS_PER_SPACE = 4, 5, 6
"""Rows of the table that are zero and that have the matrix of a space, column by column; number of rows of a space.

Each of the first four rows has one column of the matrix, three times in succession."""
MIN_DETERMINANT = 1e-18
"""Added to determinants before a division, so that a joint that is scaled to zero gives finite values."""


@dataclass(frozen=True)
class Features:
    """The features in the graph.

    Attributes:
        name: name of the (N, B, 3) vectors, in this order: controls, joints, a zero vector, other blocks.
        direct_count: B', the number of vectors of controls and joints, including the zero vector. The other vectors
            are functions of these.
        element_count: 3 B.
        position: (F,) int64, index of each feature of `NetworkInputs` among the 3 B elements; -1 for a feature that is
            not needed.
        table: name of (N, ·, 12) matrices column by column, with pose matrices and half-rotation matrices among them.
        pose_rows: (2 J,) int64, rows of the table with the pose matrices, then with the half-rotation matrices; -1 for
            matrices that are not in the table.
    """

    name: str
    direct_count: int
    element_count: int
    position: np.ndarray
    table: str
    pose_rows: np.ndarray

    @property
    def ones_vector(self) -> int:
        """Index of the vector that the clamping sets to ones. It is the constant input for biases."""
        return self.direct_count - 1

    def reorder_bounds(self, values: np.ndarray) -> np.ndarray:
        """Reorder (F,) bounds of the training range to the order of the graph; returns (B, 3) float64."""
        reordered = np.zeros(self.element_count)
        reordered[self.position[self.position >= 0]] = values[self.position >= 0]
        reordered = reordered.reshape(-1, VECTOR_SIZE)
        reordered[self.ones_vector] = 1
        return reordered


def add_features(graph: GraphBuilder, trained_model: TrainedModel) -> Features:
    """Add the nodes that compute the features of the networks and of the confidence."""
    inputs, is_needed = trained_model.inputs, _needed_features(trained_model)
    joints_block, of_joints = inputs.blocks[0], is_needed[inputs.block_slices[0]].reshape(-1, FEATURES_PER_JOINT)
    # At least one joint, because no gather may be empty.
    joints = np.flatnonzero(of_joints.any(axis=1)) if of_joints.any() else np.zeros(1, np.int64)
    name, table = _add_joint_vectors(graph, trained_model.rig, joints)
    joint_vectors = JointVectors(name, joints)
    table, pose_rows = _add_half_rotations(graph, trained_model, joint_vectors, table)
    parts = [
        (block, columns, *block.add_nodes(graph, is_needed[columns], joint_vectors))
        for block, columns in zip(inputs.blocks, inputs.block_slices, strict=True)
        if columns.stop > columns.start
    ]
    # The zero vector of the joints is the last one of the direct vectors.
    parts.sort(key=lambda part: (not part[0].is_direct, part[0] is joints_block))
    count, direct_count, all_positions = 0, 0, np.full(len(is_needed), -1, np.int64)
    for block, columns, vectors, position in parts:
        all_positions[columns] = np.where(position < 0, -1, position + VECTOR_SIZE * count)
        count += vectors.count
        direct_count += vectors.count * block.is_direct
    name = graph.join([vectors.name for _, _, vectors, _ in parts], "features", axis=1)
    return Features(name, direct_count, VECTOR_SIZE * count, all_positions, table, pose_rows)


def _add_joint_vectors(graph: GraphBuilder, rig: Rig, joints: np.ndarray) -> tuple[str, str]:
    """Add the columns of (B,) joints in the space Q_j, and a zero vector.

    Q_j = P_r B_r^-1 B_j is the joint as its reference joint r carries it along. The axes of a joint have no origin. Its
    translation is relative to Q_j.

    Returns:
        Names of the (N, 4 B + 1, 3) vectors, and of the (N, ., 12) table: B spaces Q_j, then the J joints.
    """
    count, columns = len(joints), np.arange(MATRIX_COLUMNS)
    flat_matrices = graph.reshape(_add_spaces(graph, rig, joints), [0, count + len(rig.joints), 16], "flat_spaces")
    selection = graph.floats("table_picks", _table_selection())
    table = graph.reshape(graph.add("MatMul", [flat_matrices, selection], "table_rows"), [0, -1, 12], "table")
    end_rows = np.append(ROWS_PER_SPACE * (count + joints)[:, None] + columns, ZERO_ROW)
    origin_rows = np.full(end_rows.shape, ZERO_ROW)
    origin_rows[MATRIX_COLUMNS - 1 :: MATRIX_COLUMNS] = ROWS_PER_SPACE * np.arange(count) + MATRIX_COLUMNS - 1
    spaces = np.append(np.repeat(np.arange(count), MATRIX_COLUMNS), 0)
    inverses = [_add_inverses(graph, flat_matrices), graph.integers("vector_spaces", spaces)]
    inverses = graph.add("Gather", inverses, "vector_inverses", axis=1)
    end_points = [graph.add("Gather", [table, graph.integers("vector_ends", end_rows)], "ends", axis=1)]
    end_points.append(graph.add("Gather", [table, graph.integers("vector_origins", origin_rows)], "origins", axis=1))
    offsets = graph.add("Sub", end_points, "offsets")
    row_sums = graph.floats("row_sums", np.kron(np.eye(3), np.ones((4, 1))))
    return graph.add("MatMul", [graph.add("Mul", [inverses, offsets], "terms"), row_sums], "vectors"), table


def _needed_features(trained_model: TrainedModel) -> np.ndarray:
    """Return (F,) bool, the features that a network, a partition's confidence or a half-rotation matrix depends on."""
    is_needed = np.zeros(len(trained_model.training_range.low), bool)
    counts = trained_model.training_range.counts
    is_needed[: counts.shape[1]] = counts.any(axis=0)
    for prepared in trained_model.prepared:
        is_needed[prepared.columns] = True
    by_joint = is_needed[: FEATURES_PER_JOINT * len(trained_model.rig.joints)].reshape(-1, FEATURES_PER_JOINT)
    by_joint[trained_model.half_rotation_joints()] = True
    return is_needed


def _add_spaces(graph: GraphBuilder, rig: Rig, joints: np.ndarray) -> str:
    """Add the (N, B + J, 4, 4) matrices of all spaces."""
    references, rest_matrices = rig.references[joints], rig.rest_matrices.astype(np.float64)
    is_fixed, references = (references < 0)[:, None, None], np.maximum(references, 0)
    to_child = np.linalg.inv(rest_matrices[references]) @ rest_matrices[joints]
    space_matrices = graph.add(
        "Gather", [POSE_INPUT, graph.integers("space_joints", references)], "space_poses", axis=1
    )
    offsets = graph.floats("space_offsets", np.where(is_fixed, 0, to_child))
    space_matrices = graph.add("MatMul", [space_matrices, offsets], "moved")
    if is_fixed.any():
        fixed_matrices = graph.floats("root_spaces", np.where(is_fixed, rest_matrices[joints], 0))
        space_matrices = graph.add("Add", [space_matrices, fixed_matrices], "carried")
    return graph.add("Concat", [space_matrices, POSE_INPUT], "spaces", axis=1)


def _table_selection() -> np.ndarray:
    """Return the (16, 12 rows) matrix whose product with a flattened 4x4 matrix is its rows of the table."""
    selection = np.zeros((16, ROWS_PER_SPACE, 12))
    for column, row in np.ndindex(MATRIX_COLUMNS, 3):
        selection[4 * row + column, column, [row, row + 4, row + 8]] = 1
        selection[4 * row + column, MATRIX_ROW, 3 * column + row] = 1
    return selection.reshape(16, -1)


def _add_half_rotations(
    graph: GraphBuilder, trained_model: TrainedModel, joint_vectors: JointVectors, table: str
) -> tuple[str, np.ndarray]:
    """Append the needed half-rotation matrices to the table; returns the name of the table and `Features.pose_rows`.

    They are Q_j A_j as in `half_rotation_matrices`. Their last column is zero.
    """
    joint_count, joints = len(trained_model.rig.joints), trained_model.half_rotation_joints()
    added_space_count, count = len(joint_vectors.joints), len(joints)
    matrix_rows = ROWS_PER_SPACE * (added_space_count + np.arange(joint_count)) + MATRIX_ROW
    pose_rows = np.append(matrix_rows, np.full(joint_count, -1))
    if not count:
        return table, pose_rows
    pose_rows[joint_count + joints] = ROWS_PER_SPACE * (added_space_count + joint_count) + np.arange(count)
    rotation_columns = joint_vectors.columns(joints)
    carried_spaces = rotation_columns[:, :1] // MATRIX_COLUMNS
    rotation_columns[:, -1] = MATRIX_COLUMNS * added_space_count  # the zero vector
    rotation_columns = graph.integers("rotation_columns", rotation_columns)
    rotations = graph.add("Gather", [joint_vectors.name, rotation_columns], "rotations", axis=1)
    rotation_rows = graph.reshape(rotations, [0, count, FEATURES_PER_JOINT], "rotation_rows")
    # The product with the selection is R - R^T, column by column, with zeros for the last column, and the trace.
    selection = np.zeros((FEATURES_PER_JOINT, FEATURES_PER_JOINT + 1))
    for column, axis in np.ndindex(3, 3):
        selection[3 * column + axis, 3 * column + axis] += 1
        selection[3 * axis + column, 3 * column + axis] -= 1
    selection[[0, 4, 8], -1] = 1
    terms = graph.add("MatMul", [rotation_rows, graph.floats("half_rotation_picks", selection)], "half_rotation_terms")
    names = ["half_rotation_differences", "half_rotation_traces"]
    differences, trace = graph.split(terms, [FEATURES_PER_JOINT, 1], names, axis=2)
    divisor = graph.add("Add", [trace, graph.floats("three", np.full(1, 3))], "half_rotation_divisors")
    divisor = graph.add("Max", [divisor, graph.floats("min_divisor", np.full(1, MIN_DIVISOR))], "safe_divisors")
    half_rotations = graph.add("Div", [differences, divisor], "half_rotations_in_row")
    matrices = graph.reshape(half_rotations, [0, count, MATRIX_COLUMNS, 3], "half_rotations")
    table_columns = graph.reshape(table, [0, -1, 3], "table_columns")
    carried_columns = MATRIX_COLUMNS * (ROWS_PER_SPACE * carried_spaces + MATRIX_ROW) + np.arange(3)
    carried_columns = graph.integers("carried_columns", carried_columns)
    carried_axes = graph.add("Gather", [table_columns, carried_columns], "carried_axes", axis=1)
    matrices = graph.add("MatMul", [matrices, carried_axes], "half_rotation_matrices")
    matrices = graph.reshape(matrices, [0, count, FEATURES_PER_JOINT], "half_rotation_rows")
    return graph.add("Concat", [table, matrices], "table_with_half_rotations", axis=1), pose_rows


def _add_inverses(graph: GraphBuilder, flat_matrices: str) -> str:
    """Invert the upper left 3x3 of (N, G, 16) matrices; returns (N, G, 12), three rows that each end with a zero."""
    # Each element of the adjugate is a difference of two products. The selection by ones and zeros is exact.
    selection, signs = np.zeros((16, 48)), np.zeros((18, 12))
    for i, j in np.ndindex(3, 3):
        rows, columns = ((j + 1) % 3, (j + 2) % 3), ((i + 1) % 3, (i + 2) % 3)
        for product, product_columns in enumerate((columns, columns[::-1])):
            minor = 9 * product + 3 * i + j
            selection[4 * rows[0] + product_columns[0], minor] = 1
            selection[4 * rows[1] + product_columns[1], 18 + minor] = 1
            signs[minor, 4 * i + j] = 1 - 2 * product
        selection[4 * j + i, 36 + 4 * i + j] = 1
    selected = graph.add("MatMul", [flat_matrices, graph.floats("picks", selection)], "picked")
    *factors, transposed = graph.split(selected, [18, 18, 12], ["left", "right", "transposed"], axis=2)
    products = graph.add("Mul", factors, "products")
    adjugate = graph.add("MatMul", [products, graph.floats("minor_signs", signs)], "adjugate")
    expansions = graph.add("Mul", [adjugate, transposed], "expansions")
    # The expansions along the three rows are equal.
    determinant = graph.add("MatMul", [expansions, graph.floats("thirds", np.full((12, 1), 1 / 3))], "determinant")
    safe_determinant = graph.add("Add", [determinant, graph.floats("smallest", MIN_DETERMINANT)], "safe_determinant")
    return graph.add("Div", [adjugate, safe_determinant], "inverses")


def add_range(graph: GraphBuilder, features: Features, trained_model: TrainedModel) -> tuple[str, str]:
    """Clamp the features to the training range, and add the output `confidence`.

    Returns:
        Name of the (N, B, 3) clamped features, and name of the (N, 3 B') squared distances of the direct features from
        the range. The elements of the vector `Features.ones_vector` are 1 among these distances.
    """
    training_range, element_count = trained_model.training_range, VECTOR_SIZE * features.direct_count
    low, high = (features.reorder_bounds(values) for values in (training_range.low, training_range.high))
    raised = graph.add("Max", [features.name, graph.floats("range_low", low)], "raised")
    clamped = graph.add("Min", [raised, graph.floats("range_high", high)], "clamped")
    outside = graph.add("Sub", [features.name, clamped], "outside")
    if features.element_count > element_count:
        outside = graph.slice(outside, 0, features.direct_count, 1, "direct_outside")
    outside = graph.reshape(outside, [0, element_count], "outside_row")
    squared_outside = graph.add("Mul", [outside, outside], "outside_squared")
    counts = np.zeros((element_count, len(training_range.counts)))
    position = features.position[: len(training_range.fade_width)]
    scaled_counts = (training_range.counts / training_range.fade_width.astype(np.float64) ** 2).T
    counts[position[position >= 0]] = scaled_counts[position >= 0]
    gemm_inputs = [squared_outside, graph.floats("counts", counts), graph.floats("full_confidence", np.ones(1))]
    root = graph.add("Relu", [graph.add("Gemm", gemm_inputs, "confidence_base", alpha=-1.0)], "confidence_root")
    graph.add("Mul", [root, root], CONFIDENCE_OUTPUT)
    return clamped, squared_outside
