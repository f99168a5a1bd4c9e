# SPDX-License-Identifier: GPL-3.0-or-later
"""The part of the graph that evaluates the networks, all at once.

Networks differ in what they see and in how many shapes they have; in one product for all, each would be padded to the
largest. So first and last layers are cut into pieces of the same size: a network has as many as it needs, and what the
pieces of a first layer come to is summed. What the first layer would standardize is in its weights, as its bias is; the
last layer's is in the mean residual.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdda_addon.core.model import CONFIDENCE_OUTPUT

from .deformation import Deformation
from .nodes import Graph
from .pose_nodes import VECTOR, Features

PIECE_FLOATS, CUT_FLOATS = 800, 15_000
"""A piece costs as much time as reading so many constants, and so much more do the nodes that put pieces together."""


@dataclass(frozen=True)
class Coefficients:
    """What the networks say, times the confidence.

    Attributes:
        name: (N, ·) coefficients without the last bias, mesh units.
        first: by partition that has shapes, where its first one is; the others follow.
    """

    name: str
    first: dict[int, int]


def add_networks(graph: Graph, features: Features, clamped: str, deformation: Deformation) -> Coefficients | None:
    """Evaluate the networks, if there are any.

    Args:
        clamped: (N, B, 3) features.
    """
    learned = [n for n, count in enumerate(deformation.shape_counts()) if count]
    if not learned:
        return None
    networks = [deformation.networks[n] for n in learned]
    first = [_first_layer(features, deformation, n) for n in learned]
    hidden = [np.stack(layers) for layers in zip(*(network.weights[1:-1] for network in networks), strict=True)]
    biases = [np.stack(layers)[:, None] for layers in zip(*(network.biases[1:-1] for network in networks), strict=True)]
    values = _add_first_layer(graph, clamped, first)
    values = _activation(graph, values, deformation.activation, "hidden_0")
    for layer, (weights, bias) in enumerate(zip(hidden, biases, strict=True), 1):
        values = graph.add("MatMul", [values, graph.floats(f"weights_{layer}", weights)], f"product_{layer}")
        values = graph.add("Add", [values, graph.floats(f"biases_{layer}", bias)], f"layer_{layer}")
        values = _activation(graph, values, deformation.activation, f"hidden_{layer}")
    return _add_last_layer(graph, values, {n: deformation.networks[n].weights[-1] for n in learned})


def _piece_size(sizes: Sequence[int], width: int, joint: int) -> int:
    """How large to make the pieces, so that a frame takes least time.

    Args:
        sizes: of the layers.
        width: numbers for each unit of size.
        joint: numbers that a piece takes to be put together with others.
    """

    def cost(size: int) -> int:
        pieces = sum(-(-own // size) for own in sizes)
        together = CUT_FLOATS + pieces * joint if pieces > len(sizes) else 0
        return pieces * (size * width + PIECE_FLOATS) + together

    return min(range(1, max(sizes) + 1), key=cost)


def _pieces(sizes: Sequence[int], size: int) -> list[tuple[int, slice]]:
    """The pieces of layers: whose they are, and which part."""
    return [(n, slice(start, start + size)) for n, own in enumerate(sizes) for start in range(0, own, size)]


def _add_first_layer(graph: Graph, clamped: str, layers: list[tuple[np.ndarray, np.ndarray]]) -> str:
    """(L, N, H) what first layers, as `_first_layer` gives them, say of (N, B, 3) features."""
    sizes, units = [len(vectors) for vectors, _ in layers], layers[0][1].shape[2]
    size = _piece_size(sizes, VECTOR * units, len(layers))
    pieces = _pieces(sizes, size)
    seen, weights = np.zeros((len(pieces), size), np.int64), np.zeros((len(pieces), size, VECTOR, units))
    owners = np.zeros((len(layers), len(pieces)))
    for number, (n, part) in enumerate(pieces):
        vectors, own = (array[part] for array in layers[n])
        seen[number, : len(vectors)], weights[number, : len(vectors)] = vectors, own
        owners[n, number] = 1
    weights = graph.floats("weights_0", weights.reshape(len(pieces), -1, units))
    values = graph.add("Gather", [clamped, graph.integers("vectors_of_pieces", seen)], "seen", axis=1)
    values = graph.reshape(values, [0, len(pieces), VECTOR * size], "seen_rows")
    values = graph.add("Transpose", [values], "inputs", perm=[1, 0, 2])
    values = graph.add("MatMul", [values, weights], "layer_0")
    if len(pieces) > len(layers):
        values = graph.reshape(values, [len(pieces), -1], "layer_pieces")
        values = graph.add("MatMul", [graph.floats("owners", owners), values], "layer_sums")
        values = graph.reshape(values, [len(layers), -1, units], "summed_layer")
    return values


def _add_last_layer(graph: Graph, values: str, layers: dict[int, np.ndarray]) -> Coefficients:
    """(L, N, H) values of hidden units to coefficients; `layers` has the weights of the output layer by partition."""
    sizes, units = [weights.shape[1] for weights in layers.values()], next(iter(layers.values())).shape[0]
    size = _piece_size(sizes, units, units)
    pieces, partitions = _pieces(sizes, size), list(layers)
    owners, weights = [n for n, _ in pieces], np.zeros((len(pieces), units, size))
    for number, (n, part) in enumerate(pieces):
        own = layers[partitions[n]][:, part]
        weights[number, :, : own.shape[1]] = own
    if len(pieces) > len(layers):
        values = graph.add("Gather", [values, graph.integers("piece_owners", owners)], "hidden_of_pieces", axis=0)
    values = graph.add("MatMul", [values, graph.floats("output_weights", weights)], "coefficients_by_piece")
    values = graph.add("Transpose", [values], "coefficients", perm=[1, 0, 2])
    confidence = graph.integers("confidence_of_pieces", np.array([[partitions[n]] for n in owners]))
    confidence = graph.add("Gather", [CONFIDENCE_OUTPUT, confidence], "confidence_by_piece", axis=1)
    values = graph.add("Mul", [values, confidence], "scaled_coefficients")
    name = graph.reshape(values, [0, len(pieces) * size], "coefficient_row")
    return Coefficients(name, {partition: size * owners.index(n) for n, partition in enumerate(layers)})


def _first_layer(features: Features, deformation: Deformation, n: int) -> tuple[np.ndarray, np.ndarray]:
    """The vectors that a network sees, and its first layer for these as they are, not standardized.

    Returns:
        (Bn,) int64 vectors, the last of them ones; (Bn, 3, H) float64 weights, in which the bias is that of a one.
    """
    prepared, network = deformation.prepared[n], deformation.networks[n]
    place = features.place[deformation.seen_columns(n)]
    vectors, which = np.unique(place // VECTOR, return_inverse=True)
    scaled = network.weights[0].astype(np.float64) / prepared.feature_scale[:, None]
    weight = np.zeros((len(vectors) + 1, VECTOR, scaled.shape[1]))
    weight[which, place % VECTOR] = scaled
    weight[-1, -1] = network.biases[0] - prepared.feature_mean.astype(np.float64) @ scaled
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
