# SPDX-License-Identifier: GPL-3.0-or-later
"""Graph nodes that compute surface frames, by the same steps as `SurfaceFrameFeatures.evaluate`."""

import numpy as np

from fdda_addon.core.model import POSE_INPUT

from .graph_builder import GraphBuilder
from .surface_frames import MIN_SQUARED_LENGTH, SurfaceFrameFeatures

MATRIX_ROWS = 4
"""Rows of a pose matrix. The last row is kept because removing it takes longer; it does not affect the result."""


def add_surface_frames(graph: GraphBuilder, surface_frames: SurfaceFrameFeatures) -> str:
    """Add the nodes that compute the features of D surface frames, D > 0.

    Returns:
        Name of the (N, D, 3) features, in the space of the main joints, mesh units.
    """
    (count, corners), columns = surface_frames.lengths.shape[1:], surface_frames.tangents.shape[3]
    # Corner by corner: a sum over the corners then adds contiguous rows.
    tangent_weights, epsilons, lengths = (
        array.swapaxes(1, 2) for array in (surface_frames.tangents, surface_frames.epsilons, surface_frames.lengths)
    )
    rows = graph.add("Transpose", [POSE_INPUT], "poses_by_row", perm=[0, 2, 1, 3])
    poses = graph.reshape(rows, [0, MATRIX_ROWS, columns], "pose_columns")
    tangents = [
        graph.add(
            "MatMul", [poses, graph.floats(f"{kind}_of_poses", weights.reshape(-1, columns).T)], f"{kind}_tangents"
        )
        for kind, weights in zip(("first", "second"), tangent_weights, strict=True)
    ]
    # a x b = (a_y b_z, a_z b_x, a_x b_y) - (a_z b_y, a_x b_z, a_y b_x)
    permuted = [
        graph.add("Gather", [tangent, graph.integers(f"{tangent}_axes", axes)], f"{tangent}_permuted", axis=1)
        for tangent, axes in zip(tangents, ([1, 2, 0, 2, 0, 1], [2, 0, 1, 1, 2, 0]), strict=True)
    ]
    signs = graph.floats("cross_signs", np.pad(np.hstack([np.eye(3), -np.eye(3)]), ((0, MATRIX_ROWS - 3), (0, 0))))
    crossed = graph.add("MatMul", [signs, graph.add("Mul", permuted, "cross_terms")], "crossed")
    # The axes of the joints are normalized together with the corner vectors, by the same nodes.
    vectors = graph.add("Concat", [*tangents, crossed, poses], "corner_vectors", axis=2)
    squared_epsilons = np.append(epsilons.ravel() ** 2, np.full(columns, MIN_SQUARED_LENGTH))
    squared = graph.add("Mul", [vectors, vectors], "vectors_squared")
    # Skin weights sum to 1 up to rounding, so the last row of a tangent is only nearly 0.
    row_mask = graph.floats("rows_in_space", [[1, 1, 1, 0]])
    squared = graph.add("MatMul", [row_mask, squared], "vector_sums")
    safe = graph.add("Add", [squared, graph.floats("least_squares", squared_epsilons)], "vectors_safe")
    target_lengths = graph.floats("vector_lengths", np.append(lengths.ravel(), np.ones(columns)))
    factor = graph.add("Div", [target_lengths, graph.add("Sqrt", [safe], "lengths_of_vectors")], "vector_factors")
    vectors = graph.add("Mul", [vectors, factor], "scaled_vectors")
    terms, axes = graph.split(vectors, [lengths.size, columns], ["surface_frame_terms", "axes"], axis=2)
    terms = graph.reshape(terms, [0, MATRIX_ROWS, len(lengths) * corners, count], "terms_by_surface_frame")
    sums = graph.add("ReduceSum", [terms, graph.integers("kinds_and_corners", [2])], "surface_frames", keepdims=0)
    # A product with the axes of all joints, then a gather of the main joint's, is faster than gathering the axes first.
    axes = graph.add("Transpose", [axes], "axes_by_row", perm=[0, 2, 1])
    projected = graph.reshape(
        graph.add("MatMul", [axes, sums], "along_axes"), [0, columns * count], "along_axes_in_row"
    )
    indices = count * (4 * surface_frames.main_joints[:, None] + np.arange(3)) + np.arange(count)[:, None]
    return graph.add(
        "Gather", [projected, graph.integers("main_joint_axes", indices)], "surface_frame_features", axis=1
    )
