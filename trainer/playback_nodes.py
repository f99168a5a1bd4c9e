# SPDX-License-Identifier: GPL-3.0-or-later
"""The part of the graph that plays: one product with a constant matrix for each partition."""

import numpy as np

from fdda_addon.core.model import POSITIONS_OUTPUT
from fdda_addon.core.skinning import SkinBlock

from .deformation import Deformation
from .nodes import Graph
from .pose_nodes import COLUMNS, Features
from .vertex_order import vertex_order


def add_playback(
    graph: Graph,
    features: Features,
    coefficients: list[str],
    places: dict[int, np.ndarray],
    trust: str,
    deformation: Deformation,
) -> None:
    """Add everything from the coefficients to the output `positions`.

    The rows of partition p, of main joint m, are
    [ P_j of the joints that skin it | t P_j of those that it is fitted to, m among them | t c_k P_m ]; its matrix is
    [ w_vj B_j^-1 (x_v, 1) | B_j^-1 u_vj, for m with the mean | shapes turned by B_m^-1 ]: the inverse rest matrices are
    in the constants.

    Args:
        features: has the poses.
        coefficients, places: of the networks, as `add_networks` gives them.
        trust: (N, P + 1), behind the trust a 1.
    """
    count = len(deformation.partitions)
    skins = [SkinBlock(deformation.rig, partition) for partition in deformation.partitions]
    joints, factors, trusts, columns = [], [], [], []
    for n, (partition, skin) in enumerate(zip(deformation.partitions, skins, strict=True)):
        fitted, shapes = deformation.prepared[n].fit.joints, deformation.shape_counts()[n]
        whole = len(skin.joints) + len(fitted)
        columns.append(_columns(len(joints), whole, shapes))
        joints += [*skin.joints.tolist(), *fitted.tolist(), *[partition.joint] * shapes]
        factors += [count] * whole + ((count + 1 + places[n]).tolist() if shapes else [])
        trusts += [count] * len(skin.joints) + [n] * (len(fitted) + shapes)
    scaled = _scaled_poses(graph, features, [trust, *coefficients], joints, factors, trusts)
    # Of each matrix the columns that are needed; a column is one piece of memory.
    rows = graph.add("Gather", [scaled, graph.integers("row_columns", np.concatenate(columns))], "rows", axis=1)
    rows = graph.add("Transpose", [rows], "rows_by_axis", perm=[0, 2, 1])
    parts = graph.split(rows, [len(own) for own in columns], [f"rows_{n}" for n in range(count)], axis=2)
    order = vertex_order([partition.vertices for partition in deformation.partitions])
    blocks = []
    for n, (part, own) in enumerate(zip(parts, order.columns, strict=True)):
        matrix = _in_order(_matrix(deformation, n, skins[n]), deformation.partitions[n].vertices, own)
        blocks.append(graph.add("MatMul", [part, graph.floats(f"matrix_{n}", matrix)], f"block_{n}"))
    joined = graph.join(blocks, "blocks", axis=2)
    joined = graph.add("Transpose", [joined], "positions_by_partition", perm=[0, 2, 1])
    order.add(graph, joined, POSITIONS_OUTPUT)


def _scaled_poses(
    graph: Graph, features: Features, scalars: list[str], joints: list[int], factors: list[int], trusts: list[int]
) -> str:
    """(N, 4 M, 3) columns of the pose matrices of M joints, each times two of the scalars."""
    joined = graph.join(scalars, "scalars", axis=1)
    chosen = [
        graph.add("Gather", [joined, graph.integers(f"row_{name}", np.array(numbers)[:, None])], f"by_{name}", axis=1)
        for name, numbers in (("factor", factors), ("trust", trusts))
    ]
    scale = graph.add("Mul", chosen, "scale")
    poses = graph.integers("row_poses", features.pose_rows[joints])
    scaled = graph.add("Gather", [features.table, poses], "unscaled", axis=1)
    scaled = graph.add("Mul", [scaled, scale], "scaled")
    return graph.reshape(scaled, [0, COLUMNS * len(joints), 3], "all_rows")


def _in_order(matrix: np.ndarray, vertices: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """A matrix of some vertices with its columns in another order, with zeros for -1 in it."""
    return np.where(columns >= 0, matrix[:, np.searchsorted(vertices, np.maximum(columns, vertices[0]))], 0)


def _columns(start: int, whole: int, shapes: int) -> np.ndarray:
    """The columns of matrices one after the other: all of the first, and of the others each three, column by column."""
    turned = COLUMNS * (start + whole + np.arange(shapes)) + np.arange(COLUMNS - 1)[:, None]
    return np.append(COLUMNS * start + np.arange(COLUMNS * whole), turned.ravel())


def _matrix(deformation: Deformation, n: int, skin: SkinBlock) -> np.ndarray:
    """(4 Jp + 4 Jf + 3 K, Vp) float64 constant matrix of a partition."""
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
    fitted = (inverse_rest[fit.joints] @ factors).reshape(-1, count)
    turned = np.einsum("ab,kvb->akv", inverse_rest[partition.joint, :3, :3], basis.shapes.reshape(own, count, 3))
    return np.concatenate([linear, fitted, turned.reshape(-1, count)])
