# SPDX-License-Identifier: GPL-3.0-or-later
"""Graph nodes that evaluate all networks at once.

Networks differ in their numbers of inputs and outputs, and one batched product would pad all to the largest network. So
first and last layers are cut into chunks of equal size. A network has as many chunks as its size requires, and the
outputs of the first layer's chunks are summed. The standardization of the features is folded into the weights and bias
of the first layer, and the last bias into the mean residual.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdda_addon.core.model import CONFIDENCE_OUTPUT

from .graph_builder import GraphBuilder
from .pose_nodes import VECTOR, Features
from .trained_model import TrainedModel

CHUNK_COST, SPLIT_COST = 800, 15_000
"""Time of one chunk, and time of the nodes that combine chunks, as numbers of constants that are read in that time."""


@dataclass(frozen=True)
class Coefficients:
    """The coefficients of all partitions, scaled by the confidence.

    Attributes:
        name: of the (N, ·) coefficients without the last bias, mesh units.
        first: position of the first coefficient of each partition with components, by partition index. The other
            coefficients of the partition follow.
    """

    name: str
    first: dict[int, int]


def add_networks(
    graph: GraphBuilder, features: Features, clamped: str, trained_model: TrainedModel
) -> Coefficients | None:
    """Add the nodes that evaluate the networks.

    Args:
        graph: graph to which the nodes are added.
        features: layout of the features.
        clamped: name of the (N, B, 3) clamped features.
        trained_model: model to export.

    Returns:
        The coefficients; None if no partition has components.
    """
    learned = [index for index, count in enumerate(trained_model.component_counts()) if count]
    if not learned:
        return None
    networks = [trained_model.networks[index] for index in learned]
    first = [_first_layer(features, trained_model, index) for index in learned]
    hidden = [np.stack(layers) for layers in zip(*(network.weights[1:-1] for network in networks), strict=True)]
    biases = [np.stack(layers)[:, None] for layers in zip(*(network.biases[1:-1] for network in networks), strict=True)]
    values = _add_first_layer(graph, clamped, first)
    values = _add_activation(graph, values, trained_model.activation, "hidden_0")
    for layer, (weights, bias) in enumerate(zip(hidden, biases, strict=True), 1):
        values = graph.add("MatMul", [values, graph.floats(f"weights_{layer}", weights)], f"product_{layer}")
        values = graph.add("Add", [values, graph.floats(f"biases_{layer}", bias)], f"layer_{layer}")
        values = _add_activation(graph, values, trained_model.activation, f"hidden_{layer}")
    return _add_last_layer(graph, values, {index: trained_model.networks[index].weights[-1] for index in learned})


def _chunk_size(sizes: Sequence[int], width: int, combine_cost: int) -> int:
    """Choose the chunk size that takes the least time per frame.

    Args:
        sizes: number of inputs or outputs of each network's layer.
        width: constants per input or output.
        combine_cost: constants per chunk that combine it with others.
    """

    def cost(size: int) -> int:
        count = sum(-(-layer_size // size) for layer_size in sizes)
        combining = SPLIT_COST + count * combine_cost if count > len(sizes) else 0
        return count * (size * width + CHUNK_COST) + combining

    return min(range(1, max(sizes) + 1), key=cost)


def _chunks(sizes: Sequence[int], size: int) -> list[tuple[int, slice]]:
    """Cut layers into chunks; returns the index of the network and the slice of its layer for each chunk."""
    return [(n, slice(start, start + size)) for n, length in enumerate(sizes) for start in range(0, length, size)]


def _add_first_layer(graph: GraphBuilder, clamped: str, layers: list[tuple[np.ndarray, np.ndarray]]) -> str:
    """Add the first layers, given as from `_first_layer`; returns (L, N, H) values before the activation."""
    sizes, units = [len(vectors) for vectors, _ in layers], layers[0][1].shape[2]
    size = _chunk_size(sizes, VECTOR * units, len(layers))
    chunks = _chunks(sizes, size)
    inputs, weights = np.zeros((len(chunks), size), np.int64), np.zeros((len(chunks), size, VECTOR, units))
    owners = np.zeros((len(layers), len(chunks)))
    for index, (network, part) in enumerate(chunks):
        vectors, chunk_weights = (array[part] for array in layers[network])
        inputs[index, : len(vectors)], weights[index, : len(vectors)] = vectors, chunk_weights
        owners[network, index] = 1
    weights = graph.floats("weights_0", weights.reshape(len(chunks), -1, units))
    values = graph.add("Gather", [clamped, graph.integers("chunk_vectors", inputs)], "chunk_features", axis=1)
    values = graph.reshape(values, [0, len(chunks), VECTOR * size], "chunk_rows")
    values = graph.add("Transpose", [values], "inputs", perm=[1, 0, 2])
    values = graph.add("MatMul", [values, weights], "layer_0")
    if len(chunks) > len(layers):
        values = graph.reshape(values, [len(chunks), -1], "layer_chunks")
        values = graph.add("MatMul", [graph.floats("owners", owners), values], "layer_sums")
        values = graph.reshape(values, [len(layers), -1, units], "summed_layer")
    return values


def _add_last_layer(graph: GraphBuilder, values: str, layers: dict[int, np.ndarray]) -> Coefficients:
    """Add the last layers.

    Args:
        graph: graph to which the nodes are added.
        values: name of the (L, N, H) values of the hidden units.
        layers: by partition index, (H, K) weights.
    """
    sizes, units = [weights.shape[1] for weights in layers.values()], next(iter(layers.values())).shape[0]
    size = _chunk_size(sizes, units, units)
    chunks, partitions = _chunks(sizes, size), list(layers)
    owners, weights = [network for network, _ in chunks], np.zeros((len(chunks), units, size))
    for index, (network, part) in enumerate(chunks):
        chunk_weights = layers[partitions[network]][:, part]
        weights[index, :, : chunk_weights.shape[1]] = chunk_weights
    if len(chunks) > len(layers):
        values = graph.add("Gather", [values, graph.integers("chunk_owners", owners)], "chunk_hidden", axis=0)
    values = graph.add("MatMul", [values, graph.floats("output_weights", weights)], "coefficients_by_chunk")
    values = graph.add("Transpose", [values], "coefficients", perm=[1, 0, 2])
    confidence = graph.integers("chunk_partitions", np.array([[partitions[network]] for network in owners]))
    confidence = graph.add("Gather", [CONFIDENCE_OUTPUT, confidence], "chunk_confidence", axis=1)
    values = graph.add("Mul", [values, confidence], "scaled_coefficients")
    name = graph.reshape(values, [0, len(chunks) * size], "coefficient_row")
    return Coefficients(name, {partition: size * owners.index(n) for n, partition in enumerate(layers)})


def _first_layer(features: Features, trained_model: TrainedModel, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Fold the standardization of the features into the first layer of a network.

    Returns:
        (Bn,) int64 indices of the vectors that are its inputs, the last one `Features.one`; (Bn, 3, H) float64 weights,
        with the bias as the weight of a constant 1.
    """
    prepared, network = trained_model.prepared[index], trained_model.networks[index]
    position = features.position[trained_model.feature_columns(index)]
    vectors, slots = np.unique(position // VECTOR, return_inverse=True)
    scaled = network.weights[0].astype(np.float64) / prepared.feature_scale[:, None]
    weights = np.zeros((len(vectors) + 1, VECTOR, scaled.shape[1]))
    weights[slots, position % VECTOR] = scaled
    weights[-1, -1] = network.biases[0] - prepared.feature_mean.astype(np.float64) @ scaled
    return np.append(vectors, features.one), weights


def _add_activation(graph: GraphBuilder, value: str, activation: str, output: str) -> str:
    if activation == "silu":
        return graph.add("Mul", [value, graph.add("Sigmoid", [value], f"{output}_sigmoid")], output)
    if activation == "gelu":
        scaled = graph.add("Mul", [value, graph.floats(f"{output}_root", np.sqrt(0.5))], f"{output}_scaled")
        error = graph.add("Erf", [scaled], f"{output}_erf")
        raised = graph.add("Add", [error, graph.floats(f"{output}_one", 1.0)], f"{output}_raised")
        halved = graph.add("Mul", [value, graph.floats(f"{output}_half", 0.5)], f"{output}_halved")
        return graph.add("Mul", [halved, raised], output)
    return graph.add({"tanh": "Tanh", "relu": "Relu"}[activation], [value], output)
