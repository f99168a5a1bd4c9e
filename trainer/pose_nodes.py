# SPDX-License-Identifier: GPL-3.0-or-later
"""Graph nodes that compute the features of a pose, clamp them to the training range, and compute the confidence.

Each three features are one vector in the space of a joint or of a carried joint, R^-1 (d - t). The vectors are columns
of a joint's matrix in the space of the joint as its parent carries it along, and points in the space of a main joint.
So all of them take one gather of spaces, two of points, and a product. Where no recorded bone is sheared, the columns
of R are orthogonal, and R^-1 is its transpose with each row divided by its squared length: a third of the nodes of an
inverse. Surface frames (`surface_frame_nodes`) follow; half-rotation matrices are computed from the same vectors.
"""

from dataclasses import dataclass

import numpy as np

from fdda_addon.core.features import FEATURES_PER_JOINT
from fdda_addon.core.model import CONFIDENCE_OUTPUT, CONTROLS_INPUT, POSE_INPUT

from .graph_builder import GraphBuilder
from .half_rotation_nodes import add_half_rotations
from .surface_frame_nodes import add_surface_frames
from .surface_frames import MIN_SQUARED_LENGTH
from .trained_model import TrainedModel

VECTOR = 3
"""Elements of a vector; features are gathered as vectors."""
COLUMNS, ZERO_ROW, MATRIX_ROW, TRANSPOSE_ROW = 4, 4, 5, 6
"""Rows of the table for a space: four with one column each, repeated three times; a zero row; the matrix column by
column; and its transpose, where no bone is sheared."""


@dataclass(frozen=True)
class Features:
    """The features in the graph.

    Attributes:
        name: of the (N, B, 3) vectors: controls, joints, a zero vector, pairs, surface frames.
        direct_count: number of vectors of controls and joints with the zero vector, B'; the others are functions of
            them.
        size: 3 B.
        position: (F,) int64, position of each feature of `NetworkInputs` among the 3 B; -1 where it is not needed.
        table: name of (N, ·, 12) matrices column by column, with pose matrices and half-rotation matrices among them.
        pose_rows: (2 J,) int64, rows of the table with the pose matrices, then with the half-rotation matrices; -1 for
            matrices that are not in the table.
    """

    name: str
    direct_count: int
    size: int
    position: np.ndarray
    table: str
    pose_rows: np.ndarray

    @property
    def one(self) -> int:
        """Index of the vector that is clamped to ones: a constant for biases."""
        return self.direct_count - 1

    def bound(self, values: np.ndarray) -> np.ndarray:
        """Convert (F,) bounds of the range to the order of the graph, (B, 3) float64."""
        ordered = np.zeros(self.size)
        ordered[self.position[self.position >= 0]] = values[self.position >= 0]
        ordered = ordered.reshape(-1, VECTOR)
        ordered[self.one] = 1
        return ordered


@dataclass(frozen=True)
class _Spaces:
    """The stacked matrices of all spaces: carried joints, points, joints.

    Attributes:
        joints: (Ju,) joints whose features are needed; the first Ju spaces are these as their parents carry them along.
        points: (M,) indices of the points that are needed; the next M spaces have them as origins.
        first_joint: index of the first of the J spaces of the joints themselves.
    """

    joints: np.ndarray
    points: np.ndarray
    first_joint: int


def add_features(graph: GraphBuilder, trained_model: TrainedModel) -> Features:
    """Add the nodes that compute the features of the networks and of the confidence."""
    inputs, joints = trained_model.inputs, _needed_joints(trained_model)
    points = np.unique(inputs.pair_points)
    spaces = _Spaces(joints, points, len(joints) + len(points))
    stack = _add_spaces(graph, trained_model, spaces)
    vector_spaces, ends, origins = _vector_indices(trained_model, spaces)
    rows = _rows_per_space(trained_model)
    flat = graph.reshape(stack, [0, spaces.first_joint + len(inputs.parents), 16], "flat_spaces")
    table = graph.add("MatMul", [flat, graph.floats("table_picks", _table_picks(rows))], "table_rows")
    table = graph.reshape(table, [0, -1, 12], "table")
    source = _add_inverses(graph, flat) if trained_model.sheared else table
    inverses = graph.add("Gather", [source, graph.integers("vector_spaces", vector_spaces)], "vector_inverses", axis=1)
    bounds = [graph.add("Gather", [table, graph.integers("vector_ends", ends)], "ends", axis=1)]
    bounds.append(graph.add("Gather", [table, graph.integers("vector_origins", origins)], "origins", axis=1))
    offsets = graph.add("Sub", bounds, "offsets")
    sums = graph.floats("row_sums", np.kron(np.eye(3), np.ones((4, 1))))
    name = graph.add("MatMul", [graph.add("Mul", [inverses, offsets], "terms"), sums], "vectors")
    if not trained_model.sheared:
        squared = graph.add("Mul", [inverses, inverses], "inverses_squared")
        name = graph.add("Div", [name, graph.add("MatMul", [squared, sums], "lengths")], "local_vectors")
    table, pose_rows = _add_half_rotations(graph, trained_model, spaces, name, table)
    position, leading = np.full(inputs.feature_count, -1, np.int64), []
    if count := inputs.control_count:
        # Repeated to fill a vector; only the first element is used.
        repeated = graph.add("Concat", [CONTROLS_INPUT] * VECTOR, "controls_repeated", axis=1)
        leading.append(graph.reshape(repeated, [0, count, VECTOR], "control_vectors"))
        position[inputs.control_start : inputs.pair_start] = np.arange(count)
    trailing = [add_surface_frames(graph, inputs.surface_frames)] if len(inputs.surface_frames) else []
    name = graph.join([*leading, name, *trailing], "features", axis=1)
    direct_count = count + COLUMNS * len(joints) + 1
    by_column = np.arange(FEATURES_PER_JOINT).reshape(VECTOR, COLUMNS).T.ravel()
    joint_positions = np.arange(VECTOR * count, VECTOR * (direct_count - 1))
    position[(FEATURES_PER_JOINT * joints[:, None] + by_column).ravel()] = joint_positions
    size = VECTOR * direct_count + inputs.feature_count - inputs.pair_start
    position[inputs.pair_start :] = np.arange(VECTOR * direct_count, size)
    return Features(name, direct_count, size, position, table, pose_rows)


def _rows_per_space(trained_model: TrainedModel) -> int:
    return TRANSPOSE_ROW + (not trained_model.sheared)


def _needed_joints(trained_model: TrainedModel) -> np.ndarray:
    """Return (Ju,) joints that a network, a partition's confidence or a half-rotation matrix depends on."""
    inputs = trained_model.inputs
    needed = trained_model.training_range.counts[:, : inputs.control_start].any(axis=0)
    for index in range(len(trained_model.partitions)):
        columns = trained_model.feature_columns(index)
        needed[columns[columns < inputs.control_start]] = True
    needed.reshape(-1, FEATURES_PER_JOINT)[trained_model.half_rotation_joints()] = True
    joints = np.flatnonzero(needed.reshape(-1, FEATURES_PER_JOINT).any(axis=1))
    # An empty gather is not possible.
    return joints if len(joints) else np.zeros(1, np.int64)


def _add_spaces(graph: GraphBuilder, trained_model: TrainedModel, spaces: _Spaces) -> str:
    """Add the (N, Ju + M + J, 4, 4) matrices of the spaces; a carried joint is Q_j = P_p B_p^-1 B_j."""
    rig, inputs = trained_model.rig, trained_model.inputs
    parents, rest = rig.parents[spaces.joints], rig.rest_matrices.astype(np.float64)
    safe_parents, is_root = np.maximum(parents, 0), (parents < 0)[:, None, None]
    to_child = np.where(is_root, 0, np.linalg.inv(rest[safe_parents]) @ rest[spaces.joints])
    to_points = np.tile(np.eye(4), (len(spaces.points), 1, 1))
    to_points[:, :3, 3] = inputs.points[spaces.points]
    sources = np.concatenate([safe_parents, inputs.point_joints[spaces.points]]).astype(np.int64)
    moved = graph.add("Gather", [POSE_INPUT, graph.integers("space_joints", sources)], "space_poses", axis=1)
    offsets = graph.floats("space_offsets", np.concatenate([to_child, to_points]))
    moved = graph.add("MatMul", [moved, offsets], "moved")
    if is_root.any():
        roots = np.concatenate([np.where(is_root, rest[spaces.joints], 0), 0 * to_points])
        moved = graph.add("Add", [moved, graph.floats("root_spaces", roots)], "carried")
    return graph.add("Concat", [moved, POSE_INPUT], "spaces", axis=1)


def _table_picks(rows: int) -> np.ndarray:
    """Return the (16, 12 rows) matrix of ones and zeros that converts a flat matrix to its rows of the table."""
    picks = np.zeros((16, rows, VECTOR, 4))
    for row, inner in np.ndindex(VECTOR, 3):
        for column in range(COLUMNS):
            picks[4 * inner + column, column, row, inner] = 1
        if rows > TRANSPOSE_ROW:
            picks[4 * inner + row, TRANSPOSE_ROW, row, inner] = 1
            # From the 1 in the corner of the matrix, as a fourth element: no length is zero.
            picks[-1, TRANSPOSE_ROW, row, 3] = np.sqrt(MIN_SQUARED_LENGTH)
    for column, row in np.ndindex(COLUMNS, 3):
        picks.reshape(16, rows, -1)[4 * row + column, MATRIX_ROW, 3 * column + row] = 1
    return picks.reshape(16, -1)


def _vector_indices(trained_model: TrainedModel, spaces: _Spaces) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the rows that make up each vector.

    Returns:
        Rows of the inverse of its space, in the table or, where bones are sheared, among the inverses; rows of its end
        and of its origin in the table.
    """
    inputs, rows = trained_model.inputs, _rows_per_space(trained_model)
    carried, posed = np.arange(len(spaces.joints)), spaces.first_joint + spaces.joints
    columns = np.arange(COLUMNS)
    # Axes have no origin; a joint's translation is relative to the carried joint.
    origins = np.where(columns == COLUMNS - 1, rows * carried[:, None] + COLUMNS - 1, ZERO_ROW).ravel()
    references = spaces.first_joint + inputs.pair_references
    points = len(spaces.joints) + np.searchsorted(spaces.points, inputs.pair_points)
    # The zero vector after the joints may be in any space.
    vector_spaces = np.concatenate([np.repeat(carried, COLUMNS), carried[:1], references])
    return (
        vector_spaces if trained_model.sheared else rows * vector_spaces + TRANSPOSE_ROW,
        np.concatenate([(rows * posed[:, None] + columns).ravel(), [ZERO_ROW], rows * points + COLUMNS - 1]),
        np.concatenate([origins, [ZERO_ROW], rows * references + COLUMNS - 1]),
    )


def _add_half_rotations(
    graph: GraphBuilder, trained_model: TrainedModel, spaces: _Spaces, vectors: str, table: str
) -> tuple[str, np.ndarray]:
    """Append the needed half-rotation matrices to the table; returns its name, and `Features.pose_rows`."""
    joint_count, half_rotations = len(trained_model.rig.joints), trained_model.half_rotation_joints()
    rows = _rows_per_space(trained_model)
    matrix_rows = rows * (spaces.first_joint + np.arange(joint_count)) + MATRIX_ROW
    pose_rows = np.append(matrix_rows, np.full(joint_count, -1))
    if len(half_rotations):
        appended = rows * (spaces.first_joint + joint_count) + np.arange(len(half_rotations))
        pose_rows[joint_count + half_rotations] = appended
        carried = np.searchsorted(spaces.joints, half_rotations)[:, None]
        zero_vector = np.full_like(carried, COLUMNS * len(spaces.joints))
        rotation_columns = np.append(COLUMNS * carried + np.arange(3), zero_vector, axis=1)
        carried_columns = COLUMNS * (rows * carried + MATRIX_ROW) + np.arange(3)
        table = add_half_rotations(graph, vectors, rotation_columns, table, carried_columns)
    return table, pose_rows


def _add_inverses(graph: GraphBuilder, flat: str) -> str:
    """Invert the upper left 3x3 of (N, G, 16) matrices; returns (N, G, 12), row by row, each followed by a zero."""
    # The adjugate consists of differences of two products. A product with ones and zeros is exact.
    picks, signs = np.zeros((16, 39)), np.zeros((18, 12))
    for i, j in np.ndindex(3, 3):
        rows, columns = ((j + 1) % 3, (j + 2) % 3), ((i + 1) % 3, (i + 2) % 3)
        for half, order in enumerate((columns, columns[::-1])):
            minor = 9 * half + 3 * i + j
            picks[4 * rows[0] + order[0], minor] = 1
            picks[4 * rows[1] + order[1], 18 + minor] = 1
            signs[minor, 4 * i + j] = 1 - 2 * half
    picks[[0, 4, 8], [36, 37, 38]] = 1
    picked = graph.add("MatMul", [flat, graph.floats("picks", picks)], "picked")
    left, right, column = graph.split(picked, [18, 18, 3], ["left", "right", "column"], axis=2)
    products = graph.add("Mul", [left, right], "products")
    adjugate = graph.add("MatMul", [products, graph.floats("minor_signs", signs)], "adjugate")
    expansion = graph.add("Mul", [graph.slice(adjugate, 0, 3, 2, "adjugate_row"), column], "expansion")
    determinant = graph.add("ReduceSum", [expansion, graph.integers("last_axis", [2])], "determinant", keepdims=1)
    safe = graph.add("Add", [determinant, graph.floats("smallest", MIN_SQUARED_LENGTH)], "safe_determinant")
    return graph.add("Div", [adjugate, safe], "inverses")


def add_range(graph: GraphBuilder, features: Features, trained_model: TrainedModel) -> tuple[str, str]:
    """Clamp the features to the training range, and add the output `confidence`.

    Returns:
        Name of the (N, B, 3) clamped features; name of (N, 3 B') squared distances of the direct features from the
        range, where the elements of `Features.one` are 1.
    """
    training_range, size = trained_model.training_range, VECTOR * features.direct_count
    low, high = (features.bound(values) for values in (training_range.low, training_range.high))
    raised = graph.add("Max", [features.name, graph.floats("range_low", low)], "raised")
    clamped = graph.add("Min", [raised, graph.floats("range_high", high)], "clamped")
    outside = graph.add("Sub", [features.name, clamped], "outside")
    if features.size > size:
        outside = graph.slice(outside, 0, features.direct_count, 1, "direct_outside")
    outside = graph.reshape(outside, [0, size], "outside_row")
    squared = graph.add("Mul", [outside, outside], "outside_squared")
    counts = np.zeros((size, len(training_range.counts)))
    position = features.position[: len(training_range.fade_width)]
    scaled_counts = (training_range.counts / training_range.fade_width.astype(np.float64) ** 2).T
    counts[position[position >= 0]] = scaled_counts[position >= 0]
    terms = [squared, graph.floats("counts", counts), graph.floats("full_confidence", np.ones(1))]
    root = graph.add("Relu", [graph.add("Gemm", terms, "confidence_base", alpha=-1.0)], "confidence_root")
    graph.add("Mul", [root, root], CONFIDENCE_OUTPUT)
    return clamped, squared
