# SPDX-License-Identifier: GPL-3.0-or-later
"""The part of the graph that evaluates the networks, in groups of similar size, padded to the largest of the group.

What the networks' first layer would standardise is in its weights, as its bias is; the last layer's is in the mean
residual.
"""

import numpy as np

from .deformation import Deformation
from .nodes import Graph
from .pose_nodes import VECTOR, Features

GROUP_FLOATS = 100_000
"""A group of its own costs as much time as reading so many constants."""
MAX_GROUPS = 8


def make_groups(deformation: Deformation) -> list[list[int]]:
    """Cut the partitions that have shapes, ordered by how many, into groups such that padding and groups cost least."""
    shapes = deformation.shape_counts()
    learned = [number for number, count in enumerate(shapes) if count]
    order = sorted(learned, key=lambda n: (shapes[n], len(deformation.prepared[n].columns), n))
    first = max((deformation.networks[n].weights[0].shape[1] for n in order), default=0)

    def cost(start: int, end: int) -> float:
        members = order[start:end]
        most = max(shapes[n] for n in members)
        inputs = max(len(deformation.prepared[n].columns) for n in members)
        last = max(deformation.networks[n].weights[-1].shape[0] for n in members)
        padded = len(members) * (inputs * first + last * most)
        return GROUP_FLOATS + padded

    # The cheapest way to cut the first `end` partitions, for every number of groups.
    best = {(0, 0): (0.0, [])}
    for groups in range(1, MAX_GROUPS + 1):
        for end in range(groups, len(order) + 1):
            ways = [
                (best[start, groups - 1][0] + cost(start, end), [*best[start, groups - 1][1], (start, end)])
                for start in range(groups - 1, end)
                if (start, groups - 1) in best
            ]
            best[end, groups] = min(ways, key=lambda way: way[0])
    cuts = min((way for (end, _), way in best.items() if end == len(order)), key=lambda way: way[0])[1]
    return [order[start:end] for start, end in cuts]


def add_networks(
    graph: Graph, features: Features, clamped: str, deformation: Deformation
) -> tuple[list[str], dict[int, np.ndarray]]:
    """Evaluate the networks.

    Args:
        clamped: (N, B, 3) features.

    Returns:
        For each group its coefficients without the last bias, (N, ·) in metres; and for each partition that has shapes
        where its own are among those of all groups, one behind the other.
    """
    outputs, places, start = [], {}, 0
    for number, group in enumerate(make_groups(deformation)):
        shapes = max(deformation.shape_counts()[n] for n in group)
        outputs.append(_group(graph, features, clamped, deformation, group, f"_{number}"))
        for place, n in enumerate(group):
            places[n] = start + place * shapes + np.arange(deformation.shape_counts()[n])
        start += len(group) * shapes
    return outputs, places


def _group(
    graph: Graph, features: Features, clamped: str, deformation: Deformation, group: list[int], suffix: str
) -> str:
    """(N, Pg K) coefficients of a group, padded."""
    layers = [_first_layer(features, deformation, n) for n in group]
    most = max(len(vectors) for vectors, _ in layers)
    networks = [deformation.networks[n] for n in group]
    seen = np.zeros((len(group), most), np.int64)
    widths = [max(network.weights[layer].shape[1] for network in networks) for layer in range(len(networks[0].weights))]
    sizes = [VECTOR * most, *widths]
    weights = [np.zeros((len(group), sizes[n], sizes[n + 1])) for n in range(len(widths))]
    biases = {layer: np.zeros((len(group), 1, width)) for layer, width in enumerate(widths[1:-1], 1)}
    for place, (network, (vectors, weight)) in enumerate(zip(networks, layers, strict=True)):
        seen[place, : len(vectors)] = vectors
        for layer, own in enumerate((weight, *network.weights[1:])):
            weights[layer][place, : own.shape[0], : own.shape[1]] = own
        for layer in biases:
            biases[layer][place, 0, : len(network.biases[layer])] = network.biases[layer]
    values = graph.add("Gather", [clamped, graph.integers(f"seen_vectors{suffix}", seen)], f"seen{suffix}", axis=1)
    values = graph.reshape(values, [0, len(group), VECTOR * most], f"seen_rows{suffix}")
    values = graph.add("Transpose", [values], f"inputs{suffix}", perm=[1, 0, 2])
    for layer, weight in enumerate(weights):
        name = f"_{layer}{suffix}"
        values = graph.add("MatMul", [values, graph.floats(f"weights{name}", weight)], f"product{name}")
        if layer in biases:
            values = graph.add("Add", [values, graph.floats(f"biases{name}", biases[layer])], f"layer{name}")
        if layer < len(weights) - 1:
            values = _activation(graph, values, deformation.activation, f"hidden{name}")
    values = graph.add("Transpose", [values], f"coefficients{suffix}", perm=[1, 0, 2])
    return graph.reshape(values, [0, len(group) * widths[-1]], f"coefficient_row{suffix}")


def _first_layer(features: Features, deformation: Deformation, n: int) -> tuple[np.ndarray, np.ndarray]:
    """The vectors that a network sees, and its first layer for these as they are, not standardised.

    Returns:
        (Bn,) int64 vectors, the last of them ones; (3 Bn, H) float64 weights, in which the bias is that of a one.
    """
    prepared, network = deformation.prepared[n], deformation.networks[n]
    place = features.place[deformation.seen_columns(n)]
    vectors, which = np.unique(place // VECTOR, return_inverse=True)
    scaled = network.weights[0].astype(np.float64) / prepared.feature_scale[:, None]
    weight = np.zeros((VECTOR * (len(vectors) + 1), scaled.shape[1]))
    weight[VECTOR * which + place % VECTOR] = scaled
    weight[-1] = network.biases[0] - prepared.feature_mean.astype(np.float64) @ scaled
    return np.append(vectors, features.one), weight


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
