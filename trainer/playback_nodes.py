# SPDX-License-Identifier: GPL-3.0-or-later
"""The part of the graph that plays: a product with a constant matrix for each partition, or for a few small ones."""

import numpy as np

from fdda_addon.core.model import POSITIONS_OUTPUT, TRUST_OUTPUT
from fdda_addon.core.skinning import SkinBlock

from .deformation import Deformation
from .nodes import Graph
from .pose_nodes import COLUMNS, VECTOR, Features
from .vertex_order import vertex_order

PADDING_FLOATS = 6_000
"""More zeros than this in the matrix of several partitions take more of a frame than another product."""


def add_playback(
    graph: Graph,
    features: Features,
    coefficients: list[str],
    places: dict[int, np.ndarray],
    outside: str,
    deformation: Deformation,
) -> None:
    """Add everything from the coefficients to the output `positions`.

    The rows of partition p, of main joint m, are
    [ P_j of the joints that skin it | t P_j of those that it is fitted to, m among them | t Q_j A_j of those to whose
    turns it is fitted (`turns`) | t c_k P_m ]; its matrix is
    [ w_vj B_j^-1 (x_v, 1) | B_j^-1 u_vj, for m with the mean | B_j^-1 u_vj | shapes turned by B_m^-1 ]: the inverse
    rest matrices are in the constants.

    Args:
        features: has the poses.
        coefficients, places: of the networks, as `add_networks` gives them.
        outside: (N, 3 own), as `add_range` gives it: it has a 1 for what needs no trust.
    """
    partitions, prepared, shapes = deformation.partitions, deformation.prepared, deformation.shape_counts()
    # The ones are the last vector outside, right before the trust.
    count, one = len(partitions), VECTOR * features.one
    skins = [SkinBlock(deformation.rig, partition) for partition in partitions]
    turns = [int((own.fit.joints >= len(deformation.rig.joints)).sum()) for own in prepared]
    fits = [len(own.fit.joints) for own in prepared]
    wholes = [len(skin.joints) + fit - turn for skin, fit, turn in zip(skins, fits, turns, strict=True)]
    partial = [turn + own for turn, own in zip(turns, shapes, strict=True)]
    sizes = [COLUMNS * whole + (COLUMNS - 1) * own for whole, own in zip(wholes, partial, strict=True)]
    products = _products([(size, len(own.vertices)) for size, own in zip(sizes, partitions, strict=True)])
    ordered = [n for product in products for n in product]
    joints, factors, trusts, columns = [], [], [], []
    for n in ordered:
        columns.append(_columns(len(joints), wholes[n], partial[n]))
        joints += [*skins[n].joints.tolist(), *prepared[n].fit.joints.tolist(), *[partitions[n].joint] * shapes[n]]
        factors += [one] * (wholes[n] + turns[n]) + ((one + VECTOR + count + places[n]).tolist() if shapes[n] else [])
        trusts += [one] * len(skins[n].joints) + [one + VECTOR + n] * (fits[n] + shapes[n])
    scaled = _scaled_poses(graph, features, [outside, TRUST_OUTPUT, *coefficients], joints, factors, trusts)
    # Of each matrix the columns that are needed; a column is one piece of memory.
    rows = graph.add("Gather", [scaled, graph.integers("row_columns", np.concatenate(columns))], "rows", axis=1)
    rows = graph.add("Transpose", [rows], "rows_by_axis", perm=[0, 2, 1])
    lengths = [sum(sizes[n] for n in product) for product in products]
    parts = graph.split(rows, lengths, [f"rows_{number}" for number in range(len(products))], axis=2)
    order = vertex_order([partitions[n].vertices for n in ordered])
    matrices = {
        n: _in_order(_matrix(deformation, n, skins[n]), partitions[n].vertices, own)
        for n, own in zip(ordered, order.columns, strict=True)
    }
    blocks = []
    for number, (part, product) in enumerate(zip(parts, products, strict=True)):
        matrix = _block_diagonal([matrices[n] for n in product])
        blocks.append(graph.add("MatMul", [part, graph.floats(f"matrix_{number}", matrix)], f"block_{number}"))
    joined = graph.join(blocks, "blocks", axis=2)
    joined = graph.add("Transpose", [joined], "positions_by_partition", perm=[0, 2, 1])
    order.add(graph, joined, POSITIONS_OUTPUT)


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


def _scaled_poses(
    graph: Graph, features: Features, scalars: list[str], joints: list[int], factors: list[int], trusts: list[int]
) -> str:
    """(N, 4 M, 3) columns of M pose matrices, or of joints' turns, each times two of the scalars."""
    joined = graph.join(scalars, "scalars", axis=1)
    chosen = [
        graph.add("Gather", [joined, graph.integers(f"row_{name}", np.array(numbers)[:, None])], f"by_{name}", axis=1)
        for name, numbers in (("factor", factors), ("trust", trusts))
    ]
    # Spread over the twelve numbers by a product: to multiply each pose by one number takes three times as long.
    spread = [graph.add("Mul", chosen, "scale"), graph.floats("twelve_ones", np.ones((1, 12)))]
    scale = graph.add("MatMul", spread, "scale_of_poses")
    poses = graph.integers("row_poses", features.pose_rows[joints])
    scaled = graph.add("Gather", [features.table, poses], "unscaled", axis=1)
    scaled = graph.add("Mul", [scaled, scale], "scaled")
    return graph.reshape(scaled, [0, COLUMNS * len(joints), 3], "all_rows")


def _in_order(matrix: np.ndarray, vertices: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """A matrix of some vertices with its columns in another order, with zeros for -1 in it."""
    return np.where(columns >= 0, matrix[:, np.searchsorted(vertices, np.maximum(columns, vertices[0]))], 0)


def _columns(start: int, whole: int, partial: int) -> np.ndarray:
    """The columns of matrices one after the other: all of the first, and of the others each three, column by column."""
    turned = COLUMNS * (start + whole + np.arange(partial)) + np.arange(COLUMNS - 1)[:, None]
    return np.append(COLUMNS * start + np.arange(COLUMNS * whole), turned.ravel())


def _matrix(deformation: Deformation, n: int, skin: SkinBlock) -> np.ndarray:
    """(4 Jp + 4 Jf + 3 H + 3 K, Vp) float64 constant matrix of a partition fitted to Jf joints and to H turns."""
    inverse_rest = np.linalg.inv(deformation.rig.rest_matrices.astype(np.float64))
    partition, basis, fit = deformation.partitions[n], deformation.prepared[n].basis, deformation.prepared[n].fit
    count, own = len(partition.vertices), len(basis.shapes)
    weighted = skin.weighted_rest.reshape(len(skin.joints), 4, -1).astype(np.float64)
    linear = (inverse_rest[skin.joints] @ weighted).reshape(-1, count)
    factors = fit.factors.reshape(-1, 4, count).astype(np.float64)
    mean = basis.mean.astype(np.float64)
    if own:
        # The last bias of the network moves by the same always.
        mean = mean + deformation.networks[n].biases[-1].astype(np.float64) @ basis.shapes
    factors[np.flatnonzero(fit.joints == partition.joint), :3] += mean.reshape(count, 3).T
    fitted, whole = inverse_rest[fit.joints % len(inverse_rest)] @ factors, fit.joints < len(inverse_rest)
    turned = np.einsum("ab,kvb->akv", inverse_rest[partition.joint, :3, :3], basis.shapes.reshape(own, count, 3))
    turned = np.concatenate([fitted[~whole, :3].swapaxes(0, 1), turned], axis=1)
    return np.concatenate([linear, fitted[whole].reshape(-1, count), turned.reshape(-1, count)])
