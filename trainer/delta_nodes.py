# SPDX-License-Identifier: GPL-3.0-or-later
"""The part of the graph that computes deltas, by the same steps as `Deltas.seen`."""

import numpy as np

from .deltas import SMALLEST, Deltas
from .nodes import Graph

VECTOR = 3


def add_deltas(graph: Graph, deltas: Deltas, table: str, pose_rows: np.ndarray) -> str:
    """Add the deltas.

    Args:
        deltas: at least one.
        table: (N, ·, 12), in which the poses are, by columns of three numbers.
        pose_rows: (J,) int64, where they are in it.

    Returns:
        (N, D, 3) as their main joints see them.
    """
    count, corners = deltas.lengths.shape
    poses = graph.add("Gather", [table, graph.integers("all_poses", pose_rows)], "all_poses_whole", axis=1)
    columns = graph.reshape(poses, [0, 4 * len(pose_rows), VECTOR], "pose_columns")
    columns = graph.add("Transpose", [columns], "columns_by_axis", perm=[0, 2, 1])
    # An edge for each corner on either side: to gather them takes longer than to multiply twice.
    edges = graph.floats("edges_of_poses", deltas.edges[deltas.corners.ravel()].T)
    edges = graph.add("MatMul", [columns, edges], "edges")
    both = graph.split(edges, [count * corners] * 2, ["edges_before", "edges_after"], axis=2)
    # b x a = (b_y a_z, b_z a_x, b_x a_y) - (b_z a_y, b_x a_z, b_y a_x)
    turned = [
        graph.add("Gather", [edge, graph.integers(f"{edge}_axes", axes)], f"{edge}_turned", axis=1)
        for edge, axes in zip(both, ([1, 2, 0, 2, 0, 1], [2, 0, 1, 1, 2, 0]), strict=True)
    ]
    terms = graph.split(
        graph.add("Mul", turned, "terms_of_cross"), [VECTOR] * 2, ["cross_added", "cross_taken"], axis=1
    )
    crossed = graph.add("Sub", terms, "crossed")
    normals = _shortened(graph, crossed, deltas.least.ravel() ** 2, "normals")
    parts = graph.add("Mul", [normals, graph.floats("delta_lengths", deltas.lengths.ravel())], "delta_parts")
    parts = graph.reshape(parts, [0, VECTOR, count, corners], "delta_parts_by_vertex")
    sums = graph.add("ReduceSum", [parts, graph.integers("last_of_four", [3])], "deltas", keepdims=1)
    own = (4 * deltas.seen_from[:, None] + np.arange(VECTOR)).ravel()
    axes = _shortened(graph, columns, np.array(SMALLEST), "axes")
    axes = graph.add("Gather", [axes, graph.integers("delta_columns", own)], "delta_axes", axis=2)
    axes = graph.reshape(axes, [0, VECTOR, count, VECTOR], "axes_by_delta")
    seen = graph.add("Mul", [axes, sums], "along_axes")
    return graph.add("ReduceSum", [seen, graph.integers("space_of_four", [1])], "seen_deltas", keepdims=0)


def _shortened(graph: Graph, vectors: str, least: np.ndarray, output: str) -> str:
    """(N, 3, ·) vectors v in columns to v / sqrt(|v|^2 + least)."""
    squared = graph.add("Mul", [vectors, vectors], f"{output}_squared")
    squared = graph.add("ReduceSum", [squared, graph.integers(f"{output}_space", [1])], f"{output}_sums", keepdims=1)
    squared = graph.add("Add", [squared, graph.floats(f"{output}_least", least)], f"{output}_safe")
    return graph.add("Div", [vectors, graph.add("Sqrt", [squared], f"{output}_lengths")], output)
