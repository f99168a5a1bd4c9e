# SPDX-License-Identifier: GPL-3.0-or-later
"""The part of the graph that computes turn matrices, by the same steps as `turns.turn_matrices`."""

import numpy as np

from .nodes import Graph
from .turns import LEAST_DIVISOR

AXES, COLUMNS = 3, 4


def add_turns(graph: Graph, vectors: str, against: np.ndarray, table: str, carried: np.ndarray) -> str:
    """Add the turn matrices Q_j A_j of H joints.

    Args:
        vectors: (N, ·, 3).
        against: (H, 4) which of them are the columns of R_j, a joint as its parent's frame sees it, and a zero.
        table: (N, ·, 12), matrices by columns of three numbers.
        carried: (H, 3) which of these columns are those of Q_j, the joint as its parent carries it.

    Returns:
        The table with the turn matrices behind it, each with a column of zeros.
    """
    count = len(against)
    columns = graph.add("Gather", [vectors, graph.integers("turned_columns", against)], "turned_against", axis=1)
    row = graph.reshape(columns, [0, count, AXES * COLUMNS], "turned_in_row")
    # Column by column R - R^T, with zeros for the last, and the trace.
    picks = np.zeros((AXES * COLUMNS, AXES * COLUMNS + 1))
    for column, axis in np.ndindex(AXES, AXES):
        picks[AXES * column + axis, AXES * column + axis] += 1
        picks[AXES * axis + column, AXES * column + axis] -= 1
    picks[[0, 4, 8], -1] = 1
    terms = graph.add("MatMul", [row, graph.floats("turn_picks", picks)], "turn_terms")
    apart, trace = graph.split(terms, [AXES * COLUMNS, 1], ["turn_differences", "turn_traces"], axis=2)
    divisor = graph.add("Add", [trace, graph.floats("turn_of_nothing", np.full(1, 3))], "turn_divisors")
    divisor = graph.add("Max", [divisor, graph.floats("least_divisor", np.full(1, LEAST_DIVISOR))], "safe_divisors")
    turns = graph.reshape(graph.add("Div", [apart, divisor], "turns_in_row"), [0, count, COLUMNS, AXES], "turns")
    pieces = graph.reshape(table, [0, -1, AXES], "table_columns")
    axes = graph.add("Gather", [pieces, graph.integers("carried_columns", carried)], "carried_axes", axis=1)
    turns = graph.add("MatMul", [turns, axes], "turn_matrices")
    turns = graph.reshape(turns, [0, count, AXES * COLUMNS], "turn_rows")
    return graph.add("Concat", [table, turns], "table_with_turns", axis=1)
