# SPDX-License-Identifier: GPL-3.0-or-later
"""The part of the graph that computes deltas, by the same steps as `Deltas.seen`."""

import numpy as np

from fdda_addon.core.model import POSE_INPUT

from .deltas import SMALLEST, Deltas
from .nodes import Graph

ROWS = 4
"""Of a pose matrix. The last is carried along, which costs less than to take it off; it counts for nothing."""


def add_deltas(graph: Graph, deltas: Deltas) -> str:
    """Add the deltas, at least one: (N, D, 3) as their main joints see them."""
    (count, corners), columns = deltas.lengths.shape[1:], deltas.tangents.shape[3]
    # Corner by corner: sums over what lies next to each other go number by number.
    tangents_of, least, lengths = (array.swapaxes(1, 2) for array in (deltas.tangents, deltas.least, deltas.lengths))
    rows = graph.add("Transpose", [POSE_INPUT], "poses_by_row", perm=[0, 2, 1, 3])
    poses = graph.reshape(rows, [0, ROWS, columns], "pose_columns")
    tangents = [
        graph.add("MatMul", [poses, graph.floats(f"{kind}_of_poses", own.reshape(-1, columns).T)], f"{kind}_tangents")
        for kind, own in zip(("first", "second"), tangents_of, strict=True)
    ]
    # a x b = (a_y b_z, a_z b_x, a_x b_y) - (a_z b_y, a_x b_z, a_y b_x)
    turned = [
        graph.add("Gather", [own, graph.integers(f"{own}_axes", axes)], f"{own}_turned", axis=1)
        for own, axes in zip(tangents, ([1, 2, 0, 2, 0, 1], [2, 0, 1, 1, 2, 0]), strict=True)
    ]
    signs = graph.floats("cross_signs", np.pad(np.hstack([np.eye(3), -np.eye(3)]), ((0, ROWS - 3), (0, 0))))
    crossed = graph.add("MatMul", [signs, graph.add("Mul", turned, "cross_terms")], "crossed")
    # The axes of the joints go with the corners' vectors through the same nodes.
    vectors = graph.add("Concat", [*tangents, crossed, poses], "vectors_of_deltas", axis=2)
    least = np.append(least.ravel() ** 2, np.full(columns, SMALLEST))
    squared = graph.add("Mul", [vectors, vectors], "vectors_squared")
    # Skin weights add up to 1 but for rounding, so the last row of a tangent is only nearly 0.
    in_space = graph.floats("rows_in_space", [[1, 1, 1, 0]])
    squared = graph.add("MatMul", [in_space, squared], "vector_sums")
    safe = graph.add("Add", [squared, graph.floats("least_squares", least)], "vectors_safe")
    wanted = graph.floats("vector_lengths", np.append(lengths.ravel(), np.ones(columns)))
    factor = graph.add("Div", [wanted, graph.add("Sqrt", [safe], "lengths_of_vectors")], "vector_factors")
    vectors = graph.add("Mul", [vectors, factor], "vectors_as_long")
    parts, axes = graph.split(vectors, [lengths.size, columns], ["delta_parts", "axes"], axis=2)
    parts = graph.reshape(parts, [0, ROWS, len(lengths) * corners, count], "parts_by_delta")
    sums = graph.add("ReduceSum", [parts, graph.integers("kinds_and_corners", [2])], "deltas", keepdims=0)
    # Along the axes of all joints, of which each delta takes its own: a product is quicker than to gather the axes.
    axes = graph.add("Transpose", [axes], "axes_by_row", perm=[0, 2, 1])
    seen = graph.reshape(graph.add("MatMul", [axes, sums], "along_axes"), [0, columns * count], "along_axes_in_row")
    own = count * (4 * deltas.seen_from[:, None] + np.arange(3)) + np.arange(count)[:, None]
    return graph.add("Gather", [seen, graph.integers("own_axes", own)], "seen_deltas", axis=1)
