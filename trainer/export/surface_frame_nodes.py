# SPDX-License-Identifier: GPL-3.0-or-later
"""Graph nodes that compute surface frames in the same steps as `SurfaceFrameFeatures.evaluate`."""

import numpy as np

from fdda_addon.core.model import POSE_INPUT

from ..graph_builder import GraphBuilder
from ..inputs.surface_frames import MIN_SQUARED_LENGTH, SurfaceFrameFeatures

MATRIX_ROWS = 4
"""Number of rows of a pose matrix. The last row has no effect; removing it would take longer than computing with it."""


def add_surface_frames(graph: GraphBuilder, surface_frames: SurfaceFrameFeatures) -> str:
    """Add the nodes that compute the features of D surface frames, D > 0.

    Returns:
        Name of the (N, D, 3) features, in the space of the main joints, mesh units.
    """
    (frame_count, corner_count), column_count = surface_frames.lengths.shape[1:], surface_frames.tangents.shape[3]
    # The corners come before the frames, so that a sum over the corners adds contiguous rows.
    tangent_weights, epsilons, lengths = (
        array.swapaxes(1, 2) for array in (surface_frames.tangents, surface_frames.epsilons, surface_frames.lengths)
    )
    poses_by_row = graph.add("Transpose", [POSE_INPUT], "poses_by_row", perm=[0, 2, 1, 3])
    pose_columns = graph.reshape(poses_by_row, [0, MATRIX_ROWS, column_count], "pose_columns")
    tangents = [
        graph.add(
            "MatMul",
            [pose_columns, graph.floats(f"{tangent_name}_of_poses", weights.reshape(-1, column_count).T)],
            f"{tangent_name}_tangents",
        )
        for tangent_name, weights in zip(("first", "second"), tangent_weights, strict=True)
    ]
    # a x b = (a_y b_z, a_z b_x, a_x b_y) - (a_z b_y, a_x b_z, a_y b_x)
    permuted_tangents = [
        graph.add("Gather", [tangent, graph.integers(f"{tangent}_axes", axes)], f"{tangent}_permuted", axis=1)
        for tangent, axes in zip(tangents, ([1, 2, 0, 2, 0, 1], [2, 0, 1, 1, 2, 0]), strict=True)
    ]
    cross_signs = graph.floats(
        "cross_signs", np.pad(np.hstack([np.eye(3), -np.eye(3)]), ((0, MATRIX_ROWS - 3), (0, 0)))
    )
    normals = graph.add("MatMul", [cross_signs, graph.add("Mul", permuted_tangents, "cross_terms")], "crossed")
    # The same nodes normalize the corner vectors and the axes of the joints.
    vectors = graph.add("Concat", [*tangents, normals, pose_columns], "corner_vectors", axis=2)
    squared_epsilons = np.append(epsilons.ravel() ** 2, np.full(column_count, MIN_SQUARED_LENGTH))
    squared_lengths = graph.add("Mul", [vectors, vectors], "vectors_squared")
    # The last row of a tangent is masked, because skin weights sum to 1 only up to rounding, so it is not exactly 0.
    row_mask = graph.floats("rows_in_space", [[1, 1, 1, 0]])
    squared_lengths = graph.add("MatMul", [row_mask, squared_lengths], "vector_sums")
    safe_squared_lengths = graph.add(
        "Add", [squared_lengths, graph.floats("least_squares", squared_epsilons)], "vectors_safe"
    )
    target_lengths = graph.floats("vector_lengths", np.append(lengths.ravel(), np.ones(column_count)))
    scale_factors = graph.add(
        "Div", [target_lengths, graph.add("Sqrt", [safe_squared_lengths], "lengths_of_vectors")], "vector_factors"
    )
    vectors = graph.add("Mul", [vectors, scale_factors], "scaled_vectors")
    frame_terms, axes = graph.split(vectors, [lengths.size, column_count], ["surface_frame_terms", "axes"], axis=2)
    frame_terms = graph.reshape(
        frame_terms, [0, MATRIX_ROWS, len(lengths) * corner_count, frame_count], "terms_by_surface_frame"
    )
    frame_sums = graph.add(
        "ReduceSum", [frame_terms, graph.integers("kinds_and_corners", [2])], "surface_frames", keepdims=0
    )
    # Multiplying by the axes of all joints and then gathering the main joint's products is faster than gathering first.
    axes = graph.add("Transpose", [axes], "axes_by_row", perm=[0, 2, 1])
    projected_sums = graph.reshape(
        graph.add("MatMul", [axes, frame_sums], "along_axes"), [0, column_count * frame_count], "along_axes_in_row"
    )
    main_joint_rows = (
        frame_count * (4 * surface_frames.main_joints[:, None] + np.arange(3)) + np.arange(frame_count)[:, None]
    )
    return graph.add(
        "Gather", [projected_sums, graph.integers("main_joint_axes", main_joint_rows)], "surface_frame_features", axis=1
    )
