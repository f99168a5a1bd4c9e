# SPDX-License-Identifier: GPL-3.0-or-later
"""Graph nodes that compute the features of a pose, clamp them to the training range, and compute the confidence.

The graph computes features as vectors R^-1 (d - t) of three elements, where R and t are the axes and the translation of
a space. A vector is either a column of a joint's matrix, in the space of the carried joint, or a point, in the space of
a main joint. The carried joint is the joint as its parent carries it along. All vectors together take one gather of
spaces, two gathers of points, and one product.

If no recorded bone is sheared, the columns of R are orthogonal. R^-1 is then the transpose of R with each row divided
by its squared length, which takes a third of the nodes of an inverse. The features of surface frames
(`surface_frame_nodes`) come after the vectors. Half-rotation matrices are computed from the same vectors.
"""

from dataclasses import dataclass

import numpy as np

from fdda_addon.core.features import FEATURES_PER_JOINT
from fdda_addon.core.model import CONFIDENCE_OUTPUT, CONTROLS_INPUT, POSE_INPUT

from ..graph_builder import GraphBuilder
from ..inputs.surface_frames import MIN_SQUARED_LENGTH
from ..model import TrainedModel
from .half_rotation_nodes import add_half_rotations
from .surface_frame_nodes import add_surface_frames

VECTOR_SIZE = 3
"""Number of elements of a vector. The graph gathers three features at a time, as one vector."""
MATRIX_COLUMNS, ZERO_ROW, MATRIX_ROW, TRANSPOSE_ROW = 4, 4, 5, 6
"""Number of columns of an affine matrix, and the rows of the table for a space.

Each of the first four rows has one column of the matrix, three times in succession. `ZERO_ROW` is zero. `MATRIX_ROW`
has the matrix, column by column. `TRANSPOSE_ROW` has its transpose; it does not exist if a bone is sheared."""


@dataclass(frozen=True)
class Features:
    """The features in the graph.

    Attributes:
        name: name of the (N, B, 3) vectors, in this order: controls, joints, a zero vector, pairs, surface frames.
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


@dataclass(frozen=True)
class _SpaceLayout:
    """The order of the spaces in the stacked matrices: carried joints, then points, then joints.

    Attributes:
        joints: (Ju,) joints whose features are needed. The first Ju spaces are these joints as their parents carry them
            along.
        points: (M,) indices of the points that are needed. They are the origins of the next M spaces.
        joint_start: index of the first of the last J spaces, which are the spaces of all joints.
    """

    joints: np.ndarray
    points: np.ndarray
    joint_start: int


def add_features(graph: GraphBuilder, trained_model: TrainedModel) -> Features:
    """Add the nodes that compute the features of the networks and of the confidence."""
    inputs, joints = trained_model.inputs, _needed_joints(trained_model)
    points = np.unique(inputs.pair_points)
    space_layout = _SpaceLayout(joints, points, len(joints) + len(points))
    space_matrices = _add_spaces(graph, trained_model, space_layout)
    vector_spaces, end_rows, origin_rows = _vector_indices(trained_model, space_layout)
    rows_per_space = _rows_per_space(trained_model)
    flat_matrices = graph.reshape(
        space_matrices, [0, space_layout.joint_start + len(inputs.parents), 16], "flat_spaces"
    )
    table = graph.add(
        "MatMul", [flat_matrices, graph.floats("table_picks", _table_selection(rows_per_space))], "table_rows"
    )
    table = graph.reshape(table, [0, -1, 12], "table")
    inverse_source = _add_inverses(graph, flat_matrices) if trained_model.sheared else table
    inverses = graph.add(
        "Gather", [inverse_source, graph.integers("vector_spaces", vector_spaces)], "vector_inverses", axis=1
    )
    end_points = [graph.add("Gather", [table, graph.integers("vector_ends", end_rows)], "ends", axis=1)]
    end_points.append(graph.add("Gather", [table, graph.integers("vector_origins", origin_rows)], "origins", axis=1))
    offsets = graph.add("Sub", end_points, "offsets")
    row_sums = graph.floats("row_sums", np.kron(np.eye(3), np.ones((4, 1))))
    name = graph.add("MatMul", [graph.add("Mul", [inverses, offsets], "terms"), row_sums], "vectors")
    if not trained_model.sheared:
        squared_inverses = graph.add("Mul", [inverses, inverses], "inverses_squared")
        name = graph.add("Div", [name, graph.add("MatMul", [squared_inverses, row_sums], "lengths")], "local_vectors")
    table, pose_rows = _add_half_rotations(graph, trained_model, space_layout, name, table)
    position, control_values = np.full(inputs.feature_count, -1, np.int64), []
    if control_count := inputs.control_count:
        # A control is repeated to fill a vector. Only the first element is used.
        repeated = graph.add("Concat", [CONTROLS_INPUT] * VECTOR_SIZE, "controls_repeated", axis=1)
        control_values.append(graph.reshape(repeated, [0, control_count, VECTOR_SIZE], "control_vectors"))
        position[inputs.control_start : inputs.pair_start] = np.arange(control_count)
    surface_frame_values = [add_surface_frames(graph, inputs.surface_frames)] if len(inputs.surface_frames) else []
    name = graph.join([*control_values, name, *surface_frame_values], "features", axis=1)
    direct_count = control_count + MATRIX_COLUMNS * len(joints) + 1
    by_column = np.arange(FEATURES_PER_JOINT).reshape(VECTOR_SIZE, MATRIX_COLUMNS).T.ravel()
    joint_positions = np.arange(VECTOR_SIZE * control_count, VECTOR_SIZE * (direct_count - 1))
    position[(FEATURES_PER_JOINT * joints[:, None] + by_column).ravel()] = joint_positions
    element_count = VECTOR_SIZE * direct_count + inputs.feature_count - inputs.pair_start
    position[inputs.pair_start :] = np.arange(VECTOR_SIZE * direct_count, element_count)
    return Features(name, direct_count, element_count, position, table, pose_rows)


def _rows_per_space(trained_model: TrainedModel) -> int:
    return TRANSPOSE_ROW + (not trained_model.sheared)


def _needed_joints(trained_model: TrainedModel) -> np.ndarray:
    """Return (Ju,) joints that a network, a partition's confidence or a half-rotation matrix depends on."""
    inputs = trained_model.inputs
    is_needed = trained_model.training_range.counts[:, : inputs.control_start].any(axis=0)
    for index in range(len(trained_model.partitions)):
        columns = trained_model.feature_columns(index)
        is_needed[columns[columns < inputs.control_start]] = True
    is_needed.reshape(-1, FEATURES_PER_JOINT)[trained_model.half_rotation_joints()] = True
    joints = np.flatnonzero(is_needed.reshape(-1, FEATURES_PER_JOINT).any(axis=1))
    # An empty gather is not possible.
    return joints if len(joints) else np.zeros(1, np.int64)


def _add_spaces(graph: GraphBuilder, trained_model: TrainedModel, space_layout: _SpaceLayout) -> str:
    """Add the (N, Ju + M + J, 4, 4) matrices of all spaces. The matrix of a carried joint is Q_j = P_p B_p^-1 B_j."""
    rig, inputs = trained_model.rig, trained_model.inputs
    parents, rest_matrices = rig.parents[space_layout.joints], rig.rest_matrices.astype(np.float64)
    safe_parents, is_root = np.maximum(parents, 0), (parents < 0)[:, None, None]
    to_child = np.where(is_root, 0, np.linalg.inv(rest_matrices[safe_parents]) @ rest_matrices[space_layout.joints])
    to_points = np.tile(np.eye(4), (len(space_layout.points), 1, 1))
    to_points[:, :3, 3] = inputs.points[space_layout.points]
    source_joints = np.concatenate([safe_parents, inputs.point_joints[space_layout.points]]).astype(np.int64)
    space_matrices = graph.add(
        "Gather", [POSE_INPUT, graph.integers("space_joints", source_joints)], "space_poses", axis=1
    )
    offset_matrices = graph.floats("space_offsets", np.concatenate([to_child, to_points]))
    space_matrices = graph.add("MatMul", [space_matrices, offset_matrices], "moved")
    if is_root.any():
        root_matrices = np.concatenate([np.where(is_root, rest_matrices[space_layout.joints], 0), 0 * to_points])
        space_matrices = graph.add("Add", [space_matrices, graph.floats("root_spaces", root_matrices)], "carried")
    return graph.add("Concat", [space_matrices, POSE_INPUT], "spaces", axis=1)


def _table_selection(rows: int) -> np.ndarray:
    """Return the (16, 12 rows) matrix whose product with a flattened 4x4 matrix is its rows of the table."""
    selection = np.zeros((16, rows, VECTOR_SIZE, 4))
    for row, inner in np.ndindex(VECTOR_SIZE, 3):
        for column in range(MATRIX_COLUMNS):
            selection[4 * inner + column, column, row, inner] = 1
        if rows > TRANSPOSE_ROW:
            selection[4 * inner + row, TRANSPOSE_ROW, row, inner] = 1
            # The fourth element comes from the 1 in the corner of the matrix, so that no length is zero.
            selection[-1, TRANSPOSE_ROW, row, 3] = np.sqrt(MIN_SQUARED_LENGTH)
    for column, row in np.ndindex(MATRIX_COLUMNS, 3):
        selection.reshape(16, rows, -1)[4 * row + column, MATRIX_ROW, 3 * column + row] = 1
    return selection.reshape(16, -1)


def _vector_indices(
    trained_model: TrainedModel, space_layout: _SpaceLayout
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the indices that each vector is computed from.

    Returns:
        Index of the inverse of its space: a row of the table, or an index of an inverse if bones are sheared. Then the
        row of its end d in the table, and the row of its origin t.
    """
    inputs, rows_per_space = trained_model.inputs, _rows_per_space(trained_model)
    carried_spaces, joint_spaces = np.arange(len(space_layout.joints)), space_layout.joint_start + space_layout.joints
    columns = np.arange(MATRIX_COLUMNS)
    # The axes of a joint have no origin. Its translation is relative to the carried joint.
    origin_rows = np.where(
        columns == MATRIX_COLUMNS - 1, rows_per_space * carried_spaces[:, None] + MATRIX_COLUMNS - 1, ZERO_ROW
    ).ravel()
    reference_spaces = space_layout.joint_start + inputs.pair_references
    point_spaces = len(space_layout.joints) + np.searchsorted(space_layout.points, inputs.pair_points)
    # The zero vector after the joints may be in any space.
    vector_spaces = np.concatenate([np.repeat(carried_spaces, MATRIX_COLUMNS), carried_spaces[:1], reference_spaces])
    return (
        vector_spaces if trained_model.sheared else rows_per_space * vector_spaces + TRANSPOSE_ROW,
        np.concatenate(
            [
                (rows_per_space * joint_spaces[:, None] + columns).ravel(),
                [ZERO_ROW],
                rows_per_space * point_spaces + MATRIX_COLUMNS - 1,
            ]
        ),
        np.concatenate([origin_rows, [ZERO_ROW], rows_per_space * reference_spaces + MATRIX_COLUMNS - 1]),
    )


def _add_half_rotations(
    graph: GraphBuilder, trained_model: TrainedModel, space_layout: _SpaceLayout, vectors: str, table: str
) -> tuple[str, np.ndarray]:
    """Append the needed half-rotation matrices to the table; returns the name of the table and `Features.pose_rows`."""
    joint_count, half_rotation_joints = len(trained_model.rig.joints), trained_model.half_rotation_joints()
    rows_per_space = _rows_per_space(trained_model)
    matrix_rows = rows_per_space * (space_layout.joint_start + np.arange(joint_count)) + MATRIX_ROW
    pose_rows = np.append(matrix_rows, np.full(joint_count, -1))
    if len(half_rotation_joints):
        appended_rows = rows_per_space * (space_layout.joint_start + joint_count) + np.arange(len(half_rotation_joints))
        pose_rows[joint_count + half_rotation_joints] = appended_rows
        carried_spaces = np.searchsorted(space_layout.joints, half_rotation_joints)[:, None]
        zero_vector = np.full_like(carried_spaces, MATRIX_COLUMNS * len(space_layout.joints))
        rotation_columns = np.append(MATRIX_COLUMNS * carried_spaces + np.arange(3), zero_vector, axis=1)
        carried_columns = MATRIX_COLUMNS * (rows_per_space * carried_spaces + MATRIX_ROW) + np.arange(3)
        table = add_half_rotations(graph, vectors, rotation_columns, table, carried_columns)
    return table, pose_rows


def _add_inverses(graph: GraphBuilder, flat_matrices: str) -> str:
    """Invert the upper left 3x3 of (N, G, 16) matrices; returns (N, G, 12), three rows that each end with a zero."""
    # Each element of the adjugate is a difference of two products. The selection by ones and zeros is exact.
    selection, signs = np.zeros((16, 39)), np.zeros((18, 12))
    for i, j in np.ndindex(3, 3):
        rows, columns = ((j + 1) % 3, (j + 2) % 3), ((i + 1) % 3, (i + 2) % 3)
        for product, product_columns in enumerate((columns, columns[::-1])):
            minor = 9 * product + 3 * i + j
            selection[4 * rows[0] + product_columns[0], minor] = 1
            selection[4 * rows[1] + product_columns[1], 18 + minor] = 1
            signs[minor, 4 * i + j] = 1 - 2 * product
    selection[[0, 4, 8], [36, 37, 38]] = 1
    selected = graph.add("MatMul", [flat_matrices, graph.floats("picks", selection)], "picked")
    first_factors, second_factors, first_column = graph.split(
        selected, [18, 18, 3], ["left", "right", "column"], axis=2
    )
    products = graph.add("Mul", [first_factors, second_factors], "products")
    adjugate = graph.add("MatMul", [products, graph.floats("minor_signs", signs)], "adjugate")
    expansion = graph.add("Mul", [graph.slice(adjugate, 0, 3, 2, "adjugate_row"), first_column], "expansion")
    determinant = graph.add("ReduceSum", [expansion, graph.integers("last_axis", [2])], "determinant", keepdims=1)
    safe_determinant = graph.add("Add", [determinant, graph.floats("smallest", MIN_SQUARED_LENGTH)], "safe_determinant")
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
    confidence_root = graph.add(
        "Relu", [graph.add("Gemm", gemm_inputs, "confidence_base", alpha=-1.0)], "confidence_root"
    )
    graph.add("Mul", [confidence_root, confidence_root], CONFIDENCE_OUTPUT)
    return clamped, squared_outside
