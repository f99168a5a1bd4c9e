# SPDX-License-Identifier: GPL-3.0-or-later
"""The part of the graph that looks at the pose: features, their range, and confidence.

Every three features are one vector as a frame sees it, R^-1 (d - t): the columns of a joint's matrix as the joint sees
them that its parent carries along, and the points of other joints as a main joint sees them. So all are one gather of
frames, one of vectors and a product. Where no recorded bone is sheared the columns of R are orthogonal, whatever the
scale, and R^-1 is its transpose, each row divided by its squared length: a third of the nodes of an inverse. Deltas
(`delta_nodes`) come behind them; turn matrices, where residuals are fitted to them, follow from what their parents see.
"""

from dataclasses import dataclass

import numpy as np

from fdda_addon.core.features import FEATURES_PER_JOINT
from fdda_addon.core.model import CONFIDENCE_OUTPUT, CONTROLS_INPUT, POSE_INPUT

from .deformation import Deformation
from .delta_nodes import add_deltas
from .deltas import SMALLEST
from .nodes import Graph
from .turn_nodes import add_turns

VECTOR = 3
"""Features are gathered by so many."""
COLUMNS, ZERO, WHOLE, INVERSE = 4, 4, 5, 6
"""Rows of the table for a frame: four for its columns, each thrice; a zero; its columns one after the other; and its
transpose."""


@dataclass(frozen=True)
class Features:
    """The features in the graph.

    Attributes:
        name: (N, B, 3), of the controls first, then of the joints, then a zero, then of the pairs, then the deltas.
        own: how many of the B vectors are of controls and joints, with the zero; the others follow from these.
        size: 3 B.
        place: (F,) int64, where each feature of `Inputs` is among the 3 B; -1 where it is not needed.
        table: (N, ·, 12), in which also the poses are, and the turns, by columns of three numbers.
        pose_rows: (2 J,) int64, where the poses are in it, and behind them the turns; -1 where there is none.
    """

    name: str
    own: int
    size: int
    place: np.ndarray
    table: str
    pose_rows: np.ndarray

    @property
    def one(self) -> int:
        """Which of the vectors is clamped to ones: a constant among what changes, for biases."""
        return self.own - 1

    def bound(self, values: np.ndarray) -> np.ndarray:
        """(F,) bounds of the range in the order of the graph, (B, 3) float64."""
        ordered = np.zeros(self.size)
        ordered[self.place[self.place >= 0]] = values[self.place >= 0]
        ordered = ordered.reshape(-1, VECTOR)
        ordered[self.one] = 1
        return ordered


@dataclass(frozen=True)
class _Frames:
    """Frames from which or of which something is seen: joints carried by their parents, points, and joints.

    Attributes:
        joints: (Ju,) those whose features are needed, the first Ju frames.
        points: (M,) indices of the points that are seen; the next M frames stand on them.
        first_joint: where the frames of all J joints begin.
    """

    joints: np.ndarray
    points: np.ndarray
    first_joint: int


def add_features(graph: Graph, deformation: Deformation) -> Features:
    """Add the features that networks or confidence look at."""
    inputs, joints = deformation.inputs, _joints_needed(deformation)
    points = np.unique(inputs.pair_points)
    frames = _Frames(joints, points, len(joints) + len(points))
    stack = _add_frames(graph, deformation, frames)
    seen_from, there, origin = _vectors(deformation, frames)
    rows = INVERSE + (not deformation.sheared)
    flat = graph.reshape(stack, [0, frames.first_joint + len(inputs.parents), 16], "flat_frames")
    table = graph.add("MatMul", [flat, graph.floats("table_picks", _table_picks(rows))], "table_rows")
    table = graph.reshape(table, [0, -1, 12], "table")
    source = _inverses(graph, flat) if deformation.sheared else table
    turned = graph.add("Gather", [source, graph.integers("seen_from", seen_from)], "frames_of_vectors", axis=1)
    ends = [graph.add("Gather", [table, graph.integers("vector_there", there)], "vectors_there", axis=1)]
    ends.append(graph.add("Gather", [table, graph.integers("vector_origin", origin)], "vectors_origin", axis=1))
    apart = graph.add("Sub", ends, "apart")
    sums = graph.floats("row_sums", np.kron(np.eye(3), np.ones((4, 1))))
    name = graph.add("MatMul", [graph.add("Mul", [turned, apart], "terms"), sums], "vectors")
    if not deformation.sheared:
        squared = graph.add("Mul", [turned, turned], "frames_squared")
        name = graph.add("Div", [name, graph.add("MatMul", [squared, sums], "lengths")], "seen_vectors")
    table, pose_rows = _add_turns(graph, deformation, frames, name, table)
    place, before = np.full(inputs.size, -1, np.int64), []
    if count := inputs.control_count:
        # Three times, to fill vectors; only the first is looked at.
        thrice = graph.add("Concat", [CONTROLS_INPUT] * VECTOR, "controls_thrice", axis=1)
        before.append(graph.reshape(thrice, [0, count, VECTOR], "controls_in_vectors"))
        place[inputs.joint_columns : inputs.own_columns] = np.arange(count)
    behind = [add_deltas(graph, inputs.deltas)] if len(inputs.deltas) else []
    name = graph.join([*before, name, *behind], "features", axis=1)
    own, by_column = count + COLUMNS * len(joints) + 1, np.arange(FEATURES_PER_JOINT).reshape(VECTOR, COLUMNS).T.ravel()
    place[(FEATURES_PER_JOINT * joints[:, None] + by_column).ravel()] = np.arange(VECTOR * count, VECTOR * (own - 1))
    size = VECTOR * own + inputs.size - inputs.own_columns
    place[inputs.own_columns :] = np.arange(VECTOR * own, size)
    return Features(name, own, size, place, table, pose_rows)


def _joints_needed(deformation: Deformation) -> np.ndarray:
    """(Ju,) joints that some network sees, that count for some partition's confidence, or whose turns are needed."""
    inputs = deformation.inputs
    needed = deformation.training_range.counts[:, : inputs.joint_columns].any(axis=0)
    for number in range(len(deformation.partitions)):
        columns = deformation.seen_columns(number)
        needed[columns[columns < inputs.joint_columns]] = True
    needed.reshape(-1, FEATURES_PER_JOINT)[deformation.turns()] = True
    joints = np.flatnonzero(needed.reshape(-1, FEATURES_PER_JOINT).any(axis=1))
    # Something has to be there to be looked at.
    return joints if len(joints) else np.zeros(1, np.int64)


def _add_frames(graph: Graph, deformation: Deformation, frames: _Frames) -> str:
    """(N, Ju + M + J, 4, 4) frames: Q_j = P_p B_p^-1 B_j, the joint carried along by its parent; points; all joints."""
    rig, inputs = deformation.rig, deformation.inputs
    parents, rest = rig.parents[frames.joints], rig.rest_matrices.astype(np.float64)
    above, is_root = np.maximum(parents, 0), (parents < 0)[:, None, None]
    to_child = np.where(is_root, 0, np.linalg.inv(rest[above]) @ rest[frames.joints])
    at_points = np.tile(np.eye(4), (len(frames.points), 1, 1))
    at_points[:, :3, 3] = inputs.points[frames.points]
    sources = np.concatenate([above, inputs.point_joints[frames.points]]).astype(np.int64)
    moved = graph.add("Gather", [POSE_INPUT, graph.integers("frame_joints", sources)], "frame_poses", axis=1)
    places = graph.floats("frame_places", np.concatenate([to_child, at_points]))
    moved = graph.add("MatMul", [moved, places], "moved")
    if is_root.any():
        roots = np.concatenate([np.where(is_root, rest[frames.joints], 0), 0 * at_points])
        moved = graph.add("Add", [moved, graph.floats("frames_of_roots", roots)], "carried")
    return graph.add("Concat", [moved, POSE_INPUT], "frames", axis=1)


def _table_picks(rows: int) -> np.ndarray:
    """(16, 12 rows) that picks what the table holds of a matrix; three times as the three rows of a product want it."""
    picks = np.zeros((16, rows, VECTOR, 4))
    for row, inner in np.ndindex(VECTOR, 3):
        for column in range(COLUMNS):
            picks[4 * inner + column, column, row, inner] = 1
        if rows > INVERSE:
            picks[4 * inner + row, INVERSE, row, inner] = 1
            # Behind each row, from the 1 in the corner of the matrix: no length is zero.
            picks[-1, INVERSE, row, 3] = np.sqrt(SMALLEST)
    for column, row in np.ndindex(COLUMNS, 3):
        picks.reshape(16, rows, -1)[4 * row + column, WHOLE, 3 * column + row] = 1
    return picks.reshape(16, -1)


def _vectors(deformation: Deformation, frames: _Frames) -> tuple[np.ndarray, ...]:
    """Of each vector where the inverse of the frame is that sees it, and in the table where it ends and begins.

    The inverses of sheared frames are a table of their own, one row each.
    """
    inputs, rows = deformation.inputs, INVERSE + (not deformation.sheared)
    carried, itself = np.arange(len(frames.joints)), frames.first_joint + frames.joints
    columns = np.arange(COLUMNS)
    # Directions begin nowhere, the place of a joint at that of the joint carried along.
    origin = np.where(columns == COLUMNS - 1, rows * carried[:, None] + COLUMNS - 1, ZERO).ravel()
    references = frames.first_joint + inputs.pair_references
    points = len(frames.joints) + np.searchsorted(frames.points, inputs.pair_points)
    # Behind the joints a vector that is zero, whatever sees it.
    seen_from = np.concatenate([np.repeat(carried, COLUMNS), carried[:1], references])
    return (
        seen_from if deformation.sheared else rows * seen_from + INVERSE,
        np.concatenate([(rows * itself[:, None] + columns).ravel(), [ZERO], rows * points + COLUMNS - 1]),
        np.concatenate([origin, [ZERO], rows * references + COLUMNS - 1]),
    )


def _add_turns(
    graph: Graph, deformation: Deformation, frames: _Frames, vectors: str, table: str
) -> tuple[str, np.ndarray]:
    """Put the turn matrices that are needed behind the table; its name, and `Features.pose_rows`."""
    joints, turned = len(deformation.rig.joints), deformation.turns()
    rows = INVERSE + (not deformation.sheared)
    pose_rows = np.append(rows * (frames.first_joint + np.arange(joints)) + WHOLE, np.full(joints, -1))
    if len(turned):
        pose_rows[joints + turned] = rows * (frames.first_joint + joints) + np.arange(len(turned))
        carried = np.searchsorted(frames.joints, turned)[:, None]
        against = np.append(
            COLUMNS * carried + np.arange(3), np.full_like(carried, COLUMNS * len(frames.joints)), axis=1
        )
        table = add_turns(graph, vectors, against, table, COLUMNS * (rows * carried + WHOLE) + np.arange(3))
    return table, pose_rows


def _inverses(graph: Graph, flat: str) -> str:
    """(N, G, 16) to (N, G, 12): inverses of the upper left 3x3, row by row with a zero behind each row."""
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
    safe = graph.add("Add", [determinant, graph.floats("smallest", SMALLEST)], "safe_determinant")
    return graph.add("Div", [adjugate, safe], "inverses")


def add_range(graph: Graph, features: Features, deformation: Deformation) -> tuple[str, str]:
    """Clamp the features to the training range, and add the output `confidence`.

    Returns:
        (N, B, 3) features, clamped, and (N, 3 own) squares of how far the own ones are outside; those of `Features.one`
        are ones.
    """
    training_range, size = deformation.training_range, VECTOR * features.own
    raised = graph.add("Max", [features.name, graph.floats("range_low", features.bound(training_range.low))], "raised")
    clamped = graph.add("Min", [raised, graph.floats("range_high", features.bound(training_range.high))], "clamped")
    outside = graph.add("Sub", [features.name, clamped], "outside")
    if features.size > size:
        outside = graph.slice(outside, 0, features.own, 1, "own_outside")
    outside = graph.reshape(outside, [0, size], "outside_row")
    squared = graph.add("Mul", [outside, outside], "outside_squared")
    counts = np.zeros((size, len(training_range.counts)))
    own = features.place[: len(training_range.width)]
    counts[own[own >= 0]] = (training_range.counts / training_range.width.astype(np.float64) ** 2).T[own >= 0]
    left = [squared, graph.floats("counts", counts), graph.floats("full_confidence", np.ones(1))]
    root = graph.add("Relu", [graph.add("Gemm", left, "confidence_left", alpha=-1.0)], "confidence_root")
    graph.add("Mul", [root, root], CONFIDENCE_OUTPUT)
    return clamped, squared
