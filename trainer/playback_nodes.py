# SPDX-License-Identifier: GPL-3.0-or-later
"""The part of the graph that plays: networks, and one product with a constant matrix for each partition.

Partitions are evaluated in groups of similar size, padded to the largest of the group.
"""

import numpy as np

from fdda_addon.core.model import POSE_INPUT, POSITIONS_OUTPUT
from fdda_addon.core.skinning import SkinBlock

from .deformation import Deformation
from .nodes import Graph

GROUP_FLOATS = 30_000
"""A group of its own costs as much time as reading so many constants."""
MOST_GROUPS = 8


def make_groups(deformation: Deformation) -> list[list[int]]:
    """Cut the partitions, ordered by their number of shapes, into groups such that padding and groups cost least."""
    shapes = deformation.shape_counts()
    order = sorted(range(len(shapes)), key=lambda n: (shapes[n], len(deformation.prepared[n].columns), n))
    first = max((network.weights[0].shape[1] for network in deformation.networks), default=0)

    def cost(start: int, end: int) -> float:
        members = order[start:end]
        most = max(shapes[n] for n in members)
        inputs = max(len(deformation.prepared[n].columns) for n in members)
        last = max(deformation.networks[n].weights[-1].shape[0] for n in members)
        padded = len(members) * (inputs * first + last * most)
        return GROUP_FLOATS + padded

    # The cheapest way to cut the first `end` partitions, for every number of groups.
    best = {(0, 0): (0.0, [])}
    for groups in range(1, MOST_GROUPS + 1):
        for end in range(groups, len(order) + 1):
            ways = [
                (best[start, groups - 1][0] + cost(start, end), [*best[start, groups - 1][1], (start, end)])
                for start in range(groups - 1, end)
                if (start, groups - 1) in best
            ]
            best[end, groups] = min(ways, key=lambda way: way[0])
    cuts = min((way for (end, _), way in best.items() if end == len(order)), key=lambda way: way[0])[1]
    return [order[start:end] for start, end in cuts]


def add_playback(graph: Graph, inputs: str, trust: str, deformation: Deformation, groups: list[list[int]]) -> None:
    """Add everything from the clamped features to the output `positions`.

    The rows of partition p, of main joint m, are
    [ P_j of the joints that skin it | t P_j of those that it is fitted to, m among them | t c_k P_m ]; its matrix is
    [ w_vj B_j^-1 (x_v, 1) | B_j^-1 u_vj, for m with the mean | shapes turned by B_m^-1 ]: the inverse rest matrices are
    in the constants.

    Args:
        inputs: (N, F) standardised features.
        trust: (N, P + 1), the partitions in the order of the groups, and 1.
    """
    rig = deformation.rig
    order = [number for group in groups for number in group]
    learning = [group for group in groups if _most_shapes(deformation, group)]
    by_row = graph.add("Transpose", [POSE_INPUT], "pose_by_row", perm=[0, 2, 1, 3])
    by_row = graph.reshape(by_row, [0, 4, 4 * len(rig.joints)], "pose_rows")
    everything = [graph.slice(by_row, 0, 3, 1, "linear_rows")]
    turns_of = _turns(graph, deformation, learning) if learning else []
    for number, group in enumerate(learning):
        coefficients = _networks(graph, inputs, deformation, group, f"_{number}")
        everything.append(_residual_rows(graph, coefficients, turns_of[number], deformation, group, f"_{number}"))
    joined = graph.add("Concat", everything, "all_rows", axis=2)
    blocks = _blocks(graph, joined, trust, deformation, groups)
    joined = graph.add("Concat", blocks, "blocks", axis=2) if len(blocks) > 1 else blocks[0]
    by_vertex = graph.add("Transpose", [joined], "positions_by_partition", perm=[0, 2, 1])
    position_of = np.argsort(np.concatenate([deformation.partitions[n].vertices for n in order]))
    graph.add("Gather", [by_vertex, graph.integers("vertex_order", position_of)], POSITIONS_OUTPUT, axis=1)


def _turns(graph: Graph, deformation: Deformation, groups: list[list[int]]) -> list[str]:
    """(Pg, N, 9, 1) the 3x3 of the main joints' poses of each group."""
    mains = np.array([deformation.partitions[number].joint for group in groups for number in group])
    flat = graph.reshape(POSE_INPUT, [0, 16 * len(deformation.rig.joints)], "pose_row")
    turn = 16 * mains[:, None] + np.array([0, 1, 2, 4, 5, 6, 8, 9, 10])
    turns = graph.add("Gather", [flat, graph.integers("turn_elements", turn[:, :, None])], "turns", axis=1)
    by_partition = graph.add("Transpose", [turns], "turns_by_partition", perm=[1, 0, 2, 3])
    names = [f"turns_{number}" for number in range(len(groups))]
    return graph.split(by_partition, [len(group) for group in groups], names, axis=0)


def _networks(graph: Graph, inputs: str, deformation: Deformation, group: list[int], suffix: str) -> str:
    """(Pg, N, 1, K) coefficients of a group in metres, padded."""
    learned = [n for n in group if deformation.shape_counts()[n]]
    layers = len(deformation.networks[learned[0]].weights)
    widths = [len(bias) for bias in deformation.networks[learned[0]].biases]
    widths[-1] = _most_shapes(deformation, group)
    columns = np.zeros((len(group), max(1, *(len(deformation.prepared[n].columns) for n in group))), np.int64)
    sizes = [columns.shape[1], *widths]
    weights = [np.zeros((len(group), sizes[n], sizes[n + 1]), np.float32) for n in range(layers)]
    biases = [np.zeros((len(group), 1, width), np.float32) for width in widths]
    for place, n in enumerate(group):
        own = deformation.seen_columns(n)
        columns[place, : len(own)] = own
        if n in learned:
            network = deformation.networks[n]
            for layer, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
                weights[layer][place, : weight.shape[0], : weight.shape[1]] = weight
                biases[layer][place, 0, : len(bias)] = bias
    seen = graph.add("Gather", [inputs, graph.integers(f"seen_columns{suffix}", columns)], f"seen{suffix}", axis=1)
    values = graph.add("Transpose", [seen], f"inputs{suffix}", perm=[1, 0, 2])
    for layer, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        name = f"_{layer}{suffix}"
        values = graph.add("MatMul", [values, graph.floats(f"weights{name}", weight)], f"product{name}")
        values = graph.add("Add", [values, graph.floats(f"biases{name}", bias)], f"layer{name}")
        if layer < layers - 1:
            values = _activation(graph, values, deformation.activation, f"hidden{name}")
    return graph.add("Unsqueeze", [values, graph.integers(f"row_axis{suffix}", [2])], f"coefficients{suffix}")


def _activation(graph: Graph, value: str, activation: str, output: str) -> str:
    if activation == "silu":
        return graph.add("Mul", [value, graph.add("Sigmoid", [value], f"{output}_sigmoid")], output)
    if activation == "gelu":
        scaled = graph.add("Mul", [value, graph.floats(f"{output}_root", np.sqrt(0.5))], f"{output}_scaled")
        error = graph.add("Erf", [scaled], f"{output}_erf")
        raised = graph.add("Add", [error, graph.floats(f"{output}_one", 1.0)], f"{output}_raised")
        halved = graph.add("Mul", [value, graph.floats(f"{output}_half", 0.5)], f"{output}_halved")
        return graph.add("Mul", [halved, raised], output)
    return graph.add({"tanh": "Tanh", "relu": "Relu"}[activation], [value], output)


def _residual_rows(
    graph: Graph, coefficients: str, turns: str, deformation: Deformation, group: list[int], suffix: str
) -> str:
    """(N, 3, Pg * 3 * K) the rows c_k P_m of all partitions of a group, padded.

    Args:
        coefficients: (Pg, N, 1, K).
        turns: (Pg, N, 9, 1), the 3x3 of the main joints' poses.
    """
    shapes = _most_shapes(deformation, group)
    turned = graph.add("Mul", [turns, coefficients], f"turned{suffix}")
    turned = graph.reshape(turned, [0, -1, 3, 3 * shapes], f"turned_rows{suffix}")
    turned = graph.add("Transpose", [turned], f"rows_of_group{suffix}", perm=[1, 2, 0, 3])
    return graph.reshape(turned, [0, 3, len(group) * 3 * shapes], f"residual_rows{suffix}")


def _most_shapes(deformation: Deformation, group: list[int]) -> int:
    """Shapes of the partitions of a group, padded."""
    return max(deformation.shape_counts()[n] for n in group)


def _blocks(graph: Graph, rows: str, trust: str, deformation: Deformation, groups: list[list[int]]) -> list[str]:
    """(N, 3, Vp) positions of each partition, in the order of the groups.

    Args:
        rows: (N, 3, 4 J + all residual rows), the poses and then the groups one after the other. Each partition takes
            from them exactly what its matrix needs: the matrices are most of what a frame reads, and are not padded.
        trust: (N, P + 1), the partitions in the order of the groups, and 1.
    """
    start = 4 * len(deformation.rig.joints)
    count = len(deformation.partitions)
    columns, trusts, matrices = [], [], []
    for group in groups:
        shapes = _most_shapes(deformation, group)
        for n in group:
            skin, own = SkinBlock(deformation.rig, deformation.partitions[n]), deformation.shape_counts()[n]
            linear, fitted = (
                (4 * joints[:, None] + np.arange(4)).ravel()
                for joints in (skin.joints, deformation.prepared[n].fit.joints)
            )
            # Rows of the turned shapes lie as 3 x K, padded.
            residual = start + (np.arange(3)[:, None] * shapes + np.arange(own)).ravel()
            columns.append(np.concatenate([linear, fitted, residual]))
            trusts += [count] * len(linear) + [len(matrices)] * (len(fitted) + len(residual))
            matrices.append((n, _matrix(deformation, n, skin)))
            start += 3 * shapes
    chosen = graph.add("Gather", [rows, graph.integers("row_columns", np.concatenate(columns))], "rows", axis=2)
    by_row = graph.add("Gather", [trust, graph.integers("row_trust", [trusts])], "trust_by_row", axis=1)
    chosen = graph.add("Mul", [chosen, by_row], "trusted_rows")
    parts = graph.split(chosen, [len(own) for own in columns], [f"rows_{n}" for n, _ in matrices], axis=2)
    return [
        graph.add("MatMul", [part, graph.floats(f"matrix_{n}", matrix)], f"block_{n}")
        for part, (n, matrix) in zip(parts, matrices, strict=True)
    ]


def _matrix(deformation: Deformation, n: int, skin: SkinBlock) -> np.ndarray:
    """(4 Jp + 4 Jf + 3 K, Vp) float64 constant matrix of a partition."""
    inverse_rest = np.linalg.inv(deformation.rig.rest_matrices.astype(np.float64))
    partition, basis, fit = deformation.partitions[n], deformation.prepared[n].basis, deformation.prepared[n].fit
    count, own = len(partition.vertices), len(basis.shapes)
    weighted = skin.weighted_rest.reshape(len(skin.joints), 4, -1).astype(np.float64)
    linear = (inverse_rest[skin.joints] @ weighted).reshape(-1, count)
    factors = fit.factors.reshape(-1, 4, count).astype(np.float64)
    factors[np.flatnonzero(fit.joints == partition.joint), :3] += basis.mean.reshape(count, 3).T
    fitted = (inverse_rest[fit.joints] @ factors).reshape(-1, count)
    turned = np.einsum("ab,kvb->akv", inverse_rest[partition.joint, :3, :3], basis.shapes.reshape(own, count, 3))
    return np.concatenate([linear, fitted, turned.reshape(-1, count)])
