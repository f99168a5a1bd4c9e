# SPDX-License-Identifier: GPL-3.0-or-later
"""The part of the graph that plays: a product with a constant matrix for each partition, or for a few small ones."""

from dataclasses import dataclass, replace

import numpy as np

from fdda_addon.core.model import CONFIDENCE_OUTPUT, POSITIONS_OUTPUT
from fdda_addon.core.skinning import SkinBlock

from .deformation import Deformation
from .network_nodes import Coefficients
from .nodes import Graph
from .pose_nodes import COLUMNS, VECTOR, Features
from .vertex_order import vertex_order

PADDING_FLOATS = 6_000
"""More zeros than this in the matrix of several partitions take more of a frame than another product."""
TURN = 3 * VECTOR
"""Numbers of a matrix that turn: of its columns of three numbers the first three. They are gathered together, as each
piece that is gathered takes time, whatever its length; and so is what moves three joints."""


@dataclass(frozen=True)
class _Rows:
    """The rows of the matrix of a partition: three of each shape and turn, four of each joint, and some of nothing.

    Attributes:
        shapes: K.
        turns: joints to whose turns it is fitted, as in `JointFit`.
        joints: those that skin it, and behind them those that it is fitted to.
        skinning: how many of these skin it.
        early: how many are moved by the first rows, which are gathered with the last ones of the partition before.
        spare: rows of nothing at the end.
    """

    shapes: int
    turns: tuple[int, ...]
    joints: tuple[int, ...]
    skinning: int
    early: int = 0
    spare: int = 0

    @property
    def size(self) -> int:
        return 3 * (self.shapes + len(self.turns)) + COLUMNS * len(self.joints) + self.spare

    def are_skinning(self) -> np.ndarray:
        """(size,) bool, which are of the joints that skin it."""
        joints = np.arange(len(self.joints)) < self.skinning
        early, late = np.split(joints, [self.early])
        others = np.zeros(3 * (self.shapes + len(self.turns)), bool)
        return np.concatenate([early, others, np.repeat(joints, 3), late, np.zeros(self.spare, bool)])


def add_playback(
    graph: Graph, features: Features, coefficients: Coefficients | None, outside: str, deformation: Deformation
) -> None:
    """Add everything from the coefficients to the output `positions`.

    The rows of partition p, of main joint m, are three each of what turns and one each of what moves, of
    [ t c_k P_m | t Q_j A_j of the joints to whose turns it is fitted (`turns`) | P_j of the joints that skin it and
    t P_j of those that it is fitted to, m among them ]: first what moves its `early` joints, then all that turns, only
    turning for shapes and turns, then what moves the other joints. In the same order its matrix is of
    [ shapes turned by B_m^-1 | B_j^-1 u_vj | w_vj B_j^-1 (x_v, 1) and B_j^-1 u_vj, for m with the mean ]: the inverse
    rest matrices are in the constants. All but what skins is made of patterns in a large partition: a matrix that has
    few columns comes first there.

    Args:
        features: has the poses.
        coefficients: of the networks, if there are any, times the confidence.
        outside: (N, 3 own), as `add_range` gives it: it has a 1 for what has no confidence factor.
    """
    partitions = deformation.partitions
    skins = [SkinBlock(deformation.rig, partition) for partition in partitions]
    rows = [_rows(deformation, n, skin) for n, skin in enumerate(skins)]
    products = _products([(own.size, len(partition.vertices)) for own, partition in zip(rows, partitions, strict=True)])
    ordered = [n for product in products for n in product]
    rows = dict(zip(ordered, _by_threes([rows[n] for n in ordered]), strict=True))
    pieces, places = _add_pieces(graph, features, coefficients, outside, deformation, rows)
    gathered = graph.add("Gather", [pieces, graph.integers("pieces_of_rows", places)], "pieces_in_order", axis=1)
    gathered = graph.reshape(gathered, [0, 3 * len(places), VECTOR], "rows")
    gathered = graph.add("Transpose", [gathered], "rows_by_axis", perm=[0, 2, 1])
    lengths = [sum(rows[n].size for n in product) for product in products]
    parts = graph.split(gathered, lengths, [f"rows_{number}" for number in range(len(products))], axis=2)
    order = vertex_order([partitions[n].vertices for n in ordered])
    columns = dict(zip(ordered, order.columns, strict=True))
    blocks = []
    for number, (part, product) in enumerate(zip(parts, products, strict=True)):
        matrices = [_matrix(deformation, n, skins[n], rows[n]) for n in product]
        patterns = deformation.prepared[product[0]].patterns
        if len(product) == 1 and patterns is not None:
            to_patterns, matrices[0] = _through_patterns(matrices[0], rows[product[0]], patterns)
            to_patterns = graph.floats(f"weights_of_patterns_{number}", to_patterns)
            part = graph.add("MatMul", [part, to_patterns], f"patterns_{number}")
        for place, n in enumerate(product):
            matrices[place] = _in_order(matrices[place], partitions[n].vertices, columns[n])
        matrix = graph.floats(f"matrix_{number}", _block_diagonal(matrices))
        blocks.append(graph.add("MatMul", [part, matrix], f"block_{number}"))
    joined = graph.join(blocks, "blocks", axis=2)
    joined = graph.add("Transpose", [joined], "positions_by_partition", perm=[0, 2, 1])
    order.add(graph, joined, POSITIONS_OUTPUT)


def _rows(deformation: Deformation, n: int, skin: SkinBlock) -> _Rows:
    fit, count = deformation.prepared[n].fit.joints, len(deformation.rig.joints)
    joints = np.append(skin.joints, fit[fit < count])
    return _Rows(
        deformation.shape_counts()[n], tuple(fit[fit >= count].tolist()), tuple(joints.tolist()), len(skin.joints)
    )


def _by_threes(rows: list[_Rows]) -> list[_Rows]:
    """Move all joints by threes, where a partition ends within three with the first ones of the next."""
    result, early = [], 0
    for number, own in enumerate(rows):
        left = (early - len(own.joints)) % 3
        shared = number + 1 < len(rows) and left <= len(rows[number + 1].joints)
        result.append(replace(own, early=early, spare=0 if shared else left))
        early = left if shared else 0
    return result


def _add_pieces(
    graph: Graph,
    features: Features,
    coefficients: Coefficients | None,
    outside: str,
    deformation: Deformation,
    rows: dict[int, _Rows],
) -> tuple[str, list[int]]:
    """Add the rows of all partitions, by threes.

    Args:
        rows: by partition, in the order that they are wanted in.

    Returns:
        (N, ·, 9), and which of these follow one another.
    """
    # The ones are the last vector outside, right before the confidence, and that before the coefficients.
    one, confidence = VECTOR * features.one, VECTOR * (features.one + 1)
    poses: list[tuple[int, int]] = []
    starts = {}
    for n, own in rows.items():
        starts[n] = len(poses)
        poses += [(joint, one) for joint in own.joints[: own.skinning]]
        poses += [(joint, confidence + n) for joint in own.joints[own.skinning :]]
        poses += own.spare * [(0, one)]
    places = []
    for n, own in rows.items():
        turning = len(poses)
        if own.shapes:
            first = confidence + len(rows) + coefficients.first[n]
            poses += [(deformation.partitions[n].joint, first + shape) for shape in range(own.shapes)]
        poses += [(joint, confidence + n) for joint in own.turns]
        end = starts[n] + len(own.joints)
        places += [*range(turning, len(poses)), *range(starts[n], end)]
        places += [~(piece // 3) for piece in range(starts[n] + own.early, end, 3)]
    poses += -len(poses) % 3 * [(0, one)]
    places = [len(poses) + ~place if place < 0 else place for place in places]
    joints, factors = zip(*poses, strict=True)
    scalars = [outside, CONFIDENCE_OUTPUT, *([coefficients.name] if coefficients else [])]
    scale = graph.integers("row_factors", np.array(factors)[:, None])
    scale = graph.add("Gather", [graph.join(scalars, "scalars", axis=1), scale], "factors", axis=1)
    # Spread over the twelve numbers by a product: to multiply each pose by one number takes three times as long.
    scale = graph.add("MatMul", [scale, graph.floats("twelve_ones", np.ones((1, 12)))], "factors_of_poses")
    poses = graph.integers("row_poses", features.pose_rows[list(joints)])
    poses = graph.add("Gather", [features.table, poses], "unscaled", axis=1)
    poses = graph.add("Mul", [poses, scale], "scaled")
    turned, moved = graph.split(poses, [TURN, VECTOR], ["turned_poses", "moved_poses"], axis=2)
    moved = graph.reshape(moved, [0, -1, TURN], "moved_by_threes")
    return graph.add("Concat", [turned, moved], "pieces", axis=1), places


def _products(sizes: list[tuple[int, int]]) -> list[list[int]]:
    """Which matrices, of so many rows and columns, go into one product: small ones, with few zeros beside them."""
    products: list[list[int]] = []
    rows = columns = 0
    for n in sorted(range(len(sizes)), key=lambda n: (sizes[n][0] * sizes[n][1], n)):
        if products and sizes[n][0] * columns + sizes[n][1] * rows < PADDING_FLOATS:
            products[-1].append(n)
        else:
            products.append([n])
            rows = columns = 0
        rows, columns = rows + sizes[n][0], columns + sizes[n][1]
    return products


def _block_diagonal(matrices: list[np.ndarray]) -> np.ndarray:
    """One matrix of all, with zeros beside them."""
    rows, columns = np.cumsum([(0, 0), *(matrix.shape for matrix in matrices)], axis=0).T
    joined = np.zeros((rows[-1], columns[-1]))
    for number, matrix in enumerate(matrices):
        joined[rows[number] : rows[number + 1], columns[number] : columns[number + 1]] = matrix
    return joined


def _in_order(matrix: np.ndarray, vertices: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """A matrix of some vertices with its columns in another order, with zeros for -1 in it."""
    return np.where(columns >= 0, matrix[:, np.searchsorted(vertices, np.maximum(columns, vertices[0]))], 0)


def _through_patterns(matrix: np.ndarray, rows: _Rows, patterns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The matrix of a partition as two: from its rows to those that skin it and its patterns, and from these."""
    skins = rows.are_skinning()
    count, patterns = skins.sum(), patterns.astype(np.float64)
    first = np.zeros((len(matrix), count + len(patterns)))
    first[skins, :count] = np.eye(count)
    first[~skins, count:] = matrix[~skins] @ patterns.T
    return first, np.concatenate([matrix[skins], patterns])


def _matrix(deformation: Deformation, n: int, skin: SkinBlock, rows: _Rows) -> np.ndarray:
    """(rows, Vp) float64 constant matrix of a partition."""
    inverse_rest = np.linalg.inv(deformation.rig.rest_matrices.astype(np.float64))
    partition, basis, fit = deformation.partitions[n], deformation.prepared[n].basis, deformation.prepared[n].fit
    count = len(partition.vertices)
    weighted = skin.weighted_rest.reshape(len(skin.joints), 4, -1).astype(np.float64)
    factors = fit.factors.reshape(-1, 4, count).astype(np.float64)
    mean = basis.mean.astype(np.float64)
    if rows.shapes:
        # The last bias of the network moves by the same always.
        mean = mean + deformation.networks[n].biases[-1].astype(np.float64) @ basis.shapes
    factors[np.flatnonzero(fit.joints == partition.joint), :3] += mean.reshape(count, 3).T
    fitted, whole = inverse_rest[fit.joints % len(inverse_rest)] @ factors, fit.joints < len(inverse_rest)
    shapes = np.einsum("ab,kvb->kav", inverse_rest[partition.joint, :3, :3], basis.shapes.reshape(-1, count, 3))
    joints = np.concatenate([inverse_rest[skin.joints] @ weighted, fitted[whole]])
    early, late = np.split(joints[:, 3], [rows.early])
    parts = [early, shapes, fitted[~whole, :3], joints[:, :3], late, np.zeros((rows.spare, count))]
    return np.concatenate([part.reshape(-1, count) for part in parts])
