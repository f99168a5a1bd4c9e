# SPDX-License-Identifier: GPL-3.0-or-later
"""Graph nodes that compute half-rotation matrices, by the same steps as `half_rotations.half_rotation_matrices`."""

import numpy as np

from ..fits.half_rotations import MIN_DIVISOR
from ..graph_builder import GraphBuilder

AXIS_COUNT, MATRIX_COLUMNS = 3, 4


def add_half_rotations(
    graph: GraphBuilder, vectors: str, rotation_columns: np.ndarray, table: str, carried_columns: np.ndarray
) -> str:
    """Add the half-rotation matrices Q_j A_j of H joints.

    Args:
        graph: graph to which the nodes are added.
        vectors: name of the (N, ·, 3) vectors.
        rotation_columns: (H, 4) indices of vectors for each joint: the three columns of R_j, and a zero vector.
        table: name of the (N, ·, 12) matrices, each stored as four columns of three numbers.
        carried_columns: (H, 3) indices of the columns of Q_j in the table, where Q_j is the joint as its parent carries
            it along.

    Returns:
        Name of a table that also has the half-rotation matrices, at its end. Their last column is zero.
    """
    joint_count = len(rotation_columns)
    rotations = graph.add(
        "Gather", [vectors, graph.integers("rotation_columns", rotation_columns)], "rotations", axis=1
    )
    rotation_rows = graph.reshape(rotations, [0, joint_count, AXIS_COUNT * MATRIX_COLUMNS], "rotation_rows")
    # The product with the selection is R - R^T, column by column, with zeros for the last column, and the trace.
    selection = np.zeros((AXIS_COUNT * MATRIX_COLUMNS, AXIS_COUNT * MATRIX_COLUMNS + 1))
    for column, axis in np.ndindex(AXIS_COUNT, AXIS_COUNT):
        selection[AXIS_COUNT * column + axis, AXIS_COUNT * column + axis] += 1
        selection[AXIS_COUNT * axis + column, AXIS_COUNT * column + axis] -= 1
    selection[[0, 4, 8], -1] = 1
    terms = graph.add("MatMul", [rotation_rows, graph.floats("half_rotation_picks", selection)], "half_rotation_terms")
    differences, trace = graph.split(
        terms, [AXIS_COUNT * MATRIX_COLUMNS, 1], ["half_rotation_differences", "half_rotation_traces"], axis=2
    )
    divisor = graph.add("Add", [trace, graph.floats("three", np.full(1, 3))], "half_rotation_divisors")
    divisor = graph.add("Max", [divisor, graph.floats("min_divisor", np.full(1, MIN_DIVISOR))], "safe_divisors")
    half_rotations = graph.add("Div", [differences, divisor], "half_rotations_in_row")
    matrices = graph.reshape(half_rotations, [0, joint_count, MATRIX_COLUMNS, AXIS_COUNT], "half_rotations")
    table_columns = graph.reshape(table, [0, -1, AXIS_COUNT], "table_columns")
    carried_axes = graph.add(
        "Gather", [table_columns, graph.integers("carried_columns", carried_columns)], "carried_axes", axis=1
    )
    matrices = graph.add("MatMul", [matrices, carried_axes], "half_rotation_matrices")
    matrices = graph.reshape(matrices, [0, joint_count, AXIS_COUNT * MATRIX_COLUMNS], "half_rotation_rows")
    return graph.add("Concat", [table, matrices], "table_with_half_rotations", axis=1)
