# SPDX-License-Identifier: GPL-3.0-or-later
"""The part of the graph that looks at the pose: features, their range, and trust."""

import numpy as np

from fdda_addon.core.model import CONTROLS_INPUT, POSE_INPUT, TRUST_OUTPUT
from fdda_addon.core.rig import Rig

from .deformation import Deformation
from .inputs import FEATURES_PER_PAIR, Inputs
from .nodes import Graph

SMALLEST_DETERMINANT = 1e-18
"""Added to determinants: a joint that is scaled to nothing gives large features, not NaN, and so no trust."""


def add_features(graph: Graph, rig: Rig, inputs: Inputs) -> str:
    """(N, F) features, as `Inputs.features` has them.

    Those of a joint are Q^-1 P_j, where Q = P_p B_p^-1 B_j is the joint carried along by its parent.
    """
    parents, rest = rig.parents, rig.rest_matrices.astype(np.float64)
    above, is_root = np.maximum(parents, 0), (parents < 0)[:, None, None]
    to_child = np.where(is_root, 0, np.linalg.inv(rest[above]) @ rest)
    parent_poses = graph.add("Gather", [POSE_INPUT, graph.integers("parents", above)], "parent_poses", axis=1)
    moved = graph.add("MatMul", [parent_poses, graph.floats("rest_to_parent", to_child)], "moved")
    carried = graph.add("Add", [moved, graph.floats("rest_of_roots", np.where(is_root, rest, 0))], "carried")
    has_pairs = len(inputs.pair_points) > 0
    # The pairs need the inverses of the poses themselves: one more half of the same stack.
    stack = graph.add("Concat", [carried, POSE_INPUT], "stack", axis=1) if has_pairs else carried
    inverses = _inverses(graph, stack, len(parents) * (2 if has_pairs else 1))
    halves = graph.split(inverses, [len(parents)] * (2 if has_pairs else 1), ["carried_inverse", "pose_inverse"], 1)
    mask = np.zeros((4, 4))
    mask[:3, 3] = 1
    origins = graph.add("Mul", [carried, graph.floats("translation", mask)], "origins")
    offsets = graph.add("Sub", [POSE_INPUT, origins], "offsets")
    square = graph.reshape(halves[0], [0, len(parents), 3, 4], "carried_inverse_rows")
    relative = graph.add("MatMul", [square, offsets], "relative")
    features = graph.reshape(relative, [0, inputs.joint_columns], "joint_features")
    parts = [features, *([CONTROLS_INPUT] if inputs.control_count else [])]
    if has_pairs:
        parts.append(_pair_features(graph, halves[1], inputs))
    return graph.add("Concat", parts, "features", axis=1) if len(parts) > 1 else features


def _inverses(graph: Graph, matrices: str, count: int) -> str:
    """(N, count, 4, 4) to (N, count, 12): inverses of the upper left 3x3, row by row with a zero behind each row."""
    flat = graph.reshape(matrices, [0, count, 16], "flat_stack")
    # Adjugate: differences of two products of elements each. A product with ones and zeros is exact.
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
    safe = graph.add("Add", [determinant, graph.floats("smallest", SMALLEST_DETERMINANT)], "safe_determinant")
    return graph.add("Div", [adjugate, safe], "inverses")


def _pair_features(graph: Graph, inverses: str, inputs: Inputs) -> str:
    """(N, Q * 3) P_a^-1 P_b y_b, as sums of nine products each; tiny matrix products cost far more."""
    poses = graph.reshape(POSE_INPUT, [0, len(inputs.parents), 16], "flat_poses")
    # Every coordinate of a point three times, and every origin, as the nine products of the inverse want them.
    to_points, to_origins, sums = np.zeros((16, 12)), np.zeros((16, 12)), np.zeros((12, 3))
    for row, inner in np.ndindex(3, 3):
        to_points[4 * inner : 4 * inner + 4, 4 * row + inner] = 1
        to_origins[4 * inner + 3, 4 * row + inner] = 1
        sums[4 * row + inner, row] = 1
    moved = poses
    if not np.array_equal(inputs.point_joints, np.arange(len(inputs.parents))):
        moved = graph.add(
            "Gather", [poses, graph.integers("point_joints", inputs.point_joints)], "moved_points", axis=1
        )
    scales = np.tile(np.append(inputs.points, np.ones((len(inputs.points), 1)), axis=1), 4)
    terms = graph.add("Mul", [moved, graph.floats("points", scales)], "point_terms")
    there = graph.add("MatMul", [terms, graph.floats("to_points", to_points)], "there")
    here = graph.add("MatMul", [poses, graph.floats("to_origins", to_origins)], "here")
    references, points = (
        graph.integers(name, chosen)
        for name, chosen in (("pair_references", inputs.pair_references), ("pair_points", inputs.pair_points))
    )
    ends = [
        graph.add("Gather", [there, points], "pair_there", axis=1),
        graph.add("Gather", [here, references], "pair_here", axis=1),
    ]
    turned = [graph.add("Gather", [inverses, references], "pair_inverse", axis=1), graph.add("Sub", ends, "apart")]
    products = graph.add("Mul", turned, "pair_products")
    pairs = graph.add("MatMul", [products, graph.floats("pair_sums", sums)], "pairs")
    return graph.reshape(pairs, [0, len(inputs.pair_points) * FEATURES_PER_PAIR], "pair_features")


def add_range(graph: Graph, features: str, deformation: Deformation, order: list[int]) -> tuple[str, str]:
    """Clamp the features to the training range, and add the output `trust`.

    Args:
        features: (N, F).
        order: in which the rest of the graph wants the partitions.

    Returns:
        (N, F) standardised features, clamped, and (N, P + 1) trust in `order`, after it a 1 for what needs no trust.
    """
    trust, count, own = deformation.trust, len(order), deformation.inputs.own_columns
    mean, scale = deformation.standardisation()
    low, high = ((bound - mean) / scale for bound in (trust.low, trust.high))
    centred = graph.add("Sub", [features, graph.floats("feature_mean", mean)], "centred")
    standard = graph.add("Mul", [centred, graph.floats("feature_scale", 1 / scale)], "standard")
    raised = graph.add("Max", [standard, graph.floats("range_low", low)], "raised")
    clamped = graph.add("Min", [raised, graph.floats("range_high", high)], "clamped")
    outside = graph.add("Sub", [standard, clamped], "outside")
    if len(mean) > own:
        outside = graph.slice(outside, 0, own, 1, "joints_outside")
    excess = graph.add("Mul", [outside, graph.floats("per_fade_width", scale[:own] / trust.width)], "excess")
    squared = graph.add("Mul", [excess, excess], "excess_squared")
    # Every partition twice: as the graph wants them, and as the output lists them. Between them one that nothing takes
    # trust from.
    certain = np.zeros_like(trust.counts[:1])
    counts = np.concatenate([trust.counts[order], certain, trust.counts])
    summed = graph.add("MatMul", [squared, graph.floats("counts", counts.T)], "partition_excess")
    root = graph.add("Relu", [graph.add("Sub", [graph.floats("one", 1.0), summed], "trust_left")], "trust_root")
    both = graph.add("Mul", [root, root], "trusts")
    return clamped, graph.split(both, [count + 1, count], ["partition_trust", TRUST_OUTPUT], axis=1)[0]
