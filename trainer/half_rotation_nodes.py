# SPDX-License-Identifier: GPL-3.0-or-later
"""Graph nodes that compute half-rotation matrices, by the same steps as `half_rotations.half_rotation_matrices`."""

import numpy as np

from .graph_builder import GraphBuilder
from .half_rotations import MIN_DIVISOR

AXES, COLUMNS = 3, 4


def add_half_rotations(
    graph: GraphBuilder, vectors: str, rotation_columns: np.ndarray, table: str, carried_columns: np.ndarray
) -> str:
    """Add the half-rotation matrices Q_j A_j of H joints.

    Args:
        graph: to add the nodes to.
        vectors: name of (N, ·, 3) vectors.
        rotation_columns: (H, 4) indices of vectors: the columns of R_j, and a zero vector.
        table: name of (N, ·, 12) matrices, column by column, three numbers each.
        carried_columns: (H, 3) indices of columns of the table: those of Q_j, the joint as its parent carries it along.

    Returns:
        Name of the table followed by the half-rotation matrices, each with a column of zeros.
    """
    count = len(rotation_columns)
    columns = graph.add("Gather", [vectors, graph.integers("rotation_columns", rotation_columns)], "rotations", axis=1)
    row = graph.reshape(columns, [0, count, AXES * COLUMNS], "rotation_rows")
    # R - R^T column by column, with zeros for the last column, and the trace.
    picks = np.zeros((AXES * COLUMNS, AXES * COLUMNS + 1))
    for column, axis in np.ndindex(AXES, AXES):
        picks[AXES * column + axis, AXES * column + axis] += 1
        picks[AXES * axis + column, AXES * column + axis] -= 1
    picks[[0, 4, 8], -1] = 1
    terms = graph.add("MatMul", [row, graph.floats("half_rotation_picks", picks)], "half_rotation_terms")
    differences, trace = graph.split(
        terms, [AXES * COLUMNS, 1], ["half_rotation_differences", "half_rotation_traces"], axis=2
    )
    divisor = graph.add("Add", [trace, graph.floats("three", np.full(1, 3))], "half_rotation_divisors")
    divisor = graph.add("Max", [divisor, graph.floats("min_divisor", np.full(1, MIN_DIVISOR))], "safe_divisors")
    scaled = graph.add("Div", [differences, divisor], "half_rotations_in_row")
    matrices = graph.reshape(scaled, [0, count, COLUMNS, AXES], "half_rotations")
    table_columns = graph.reshape(table, [0, -1, AXES], "table_columns")
    axes = graph.add(
        "Gather", [table_columns, graph.integers("carried_columns", carried_columns)], "carried_axes", axis=1
    )
    matrices = graph.add("MatMul", [matrices, axes], "half_rotation_matrices")
    matrices = graph.reshape(matrices, [0, count, AXES * COLUMNS], "half_rotation_rows")
    return graph.add("Concat", [table, matrices], "table_with_half_rotations", axis=1)
