# SPDX-License-Identifier: GPL-3.0-or-later
"""Graph nodes that evaluate all networks at once.

Networks differ in their numbers of inputs and outputs, and one batched product would pad all networks to the largest
one. So first and last layers are cut into chunks of equal size. A larger network has more chunks. The outputs of the
chunks of a first layer are summed. The standardization of the features is folded into the weights and bias
of the first layer, and the last bias into the mean residual.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdda_addon.core.formats.model import CONFIDENCE_OUTPUT

from ..graph_builder import GraphBuilder, compact
from ..inputs.block import VECTOR_SIZE
from ..model import TrainedModel
from ..networks.networks import TrainedPartition
from .pose_nodes import Features

CHUNK_COST, SPLIT_COST = 800, 15_000
"""Time of one chunk, and time of the nodes that combine chunks, as numbers of constants that are read in that time."""


@dataclass(frozen=True)
class Coefficients:
    """The coefficients of all partitions, scaled by the confidence.

    Attributes:
        name: name of the (N, ·) coefficients without the last bias, mesh units.
        start_by_part: index of the first coefficient of each part with components, by the index of the part. The other
            coefficients of the part follow.
    """

    name: str
    start_by_part: dict[int, int]


def add_networks(
    graph: GraphBuilder, features: Features, clamped: str, trained_model: TrainedModel
) -> Coefficients | None:
    """Add the nodes that evaluate the networks.

    Args:
        features: layout of the features.
        clamped: name of the (N, B, 3) clamped features.

    Returns:
        The coefficients; None if no partition has components.
    """
    learned = {index: p for index, p in enumerate(trained_model.prepared) if len(p.basis.components)}
    if not learned:
        return None
    networks = [prepared.network for prepared in learned.values()]
    activation = networks[0].activation
    first_layers = [_first_layer(features, prepared) for prepared in learned.values()]
    values = _add_first_layer(graph, clamped, first_layers)
    values = _add_activation(graph, values, activation, "hidden_0")
    for layer in range(1, len(networks[0].weights) - 1):
        weights = graph.compact_floats(f"weights_{layer}", np.stack([network.weights[layer] for network in networks]))
        values = graph.add("MatMul", [values, weights], f"product_{layer}")
        biases = graph.floats(f"biases_{layer}", np.stack([network.biases[layer][None] for network in networks]))
        values = graph.add("Add", [values, biases], f"layer_{layer}")
        values = _add_activation(graph, values, activation, f"hidden_{layer}")
    layers = {index: p.network.weights[-1] for index, p in learned.items()}
    return _add_last_layer(graph, values, layers, trained_model.partition_indices())


def _chunk_size(layer_sizes: Sequence[int], width: int, combine_cost: int) -> int:
    """Choose the chunk size that takes the least time per frame.

    Args:
        layer_sizes: number of inputs or outputs of each network's layer.
        width: constants per input or output.
        combine_cost: constants per chunk that combine the chunk with others.
    """

    def cost(size: int) -> int:
        count = sum(-(-layer_size // size) for layer_size in layer_sizes)
        combining_cost = SPLIT_COST + count * combine_cost if count > len(layer_sizes) else 0
        return count * (size * width + CHUNK_COST) + combining_cost

    return min(range(1, max(layer_sizes) + 1), key=cost)


def _chunks(layer_sizes: Sequence[int], chunk_size: int) -> list[tuple[int, slice]]:
    """Cut layers into chunks; for each chunk, returns the index of its network and its slice of the layer."""
    return [
        (network, slice(start, start + chunk_size))
        for network, layer_size in enumerate(layer_sizes)
        for start in range(0, layer_size, chunk_size)
    ]


def _add_first_layer(graph: GraphBuilder, clamped: str, layers: list[tuple[np.ndarray, np.ndarray]]) -> str:
    """Add first layers as `_first_layer` returns them; returns the (L, N, H) values before the activation."""
    vector_counts, units = [len(vectors) for vectors, _ in layers], layers[0][1].shape[2]
    chunk_size = _chunk_size(vector_counts, VECTOR_SIZE * units, len(layers))
    chunks = _chunks(vector_counts, chunk_size)
    chunk_vectors = np.zeros((len(chunks), chunk_size), np.int64)
    weights = np.zeros((*chunk_vectors.shape, VECTOR_SIZE, units))
    summation_matrix = np.zeros((len(layers), len(chunks)))
    for index, (network, layer_slice) in enumerate(chunks):
        vectors, chunk_weights = (array[layer_slice] for array in layers[network])
        chunk_vectors[index, : len(vectors)], weights[index, : len(vectors)] = vectors, chunk_weights
        summation_matrix[network, index] = 1
    weights = graph.compact_floats("weights_0", weights.reshape(len(chunks), -1, units))
    values = graph.add("Gather", [clamped, graph.integers("chunk_vectors", chunk_vectors)], "chunk_features", axis=1)
    values = graph.reshape(values, [0, len(chunks), VECTOR_SIZE * chunk_size], "chunk_rows")
    values = graph.add("Transpose", [values], "inputs", perm=[1, 0, 2])
    values = graph.add("MatMul", [values, weights], "layer_0")
    if len(chunks) > len(layers):
        values = graph.reshape(values, [len(chunks), -1], "layer_chunks")
        values = graph.add("MatMul", [graph.floats("owners", summation_matrix), values], "layer_sums")
        values = graph.reshape(values, [len(layers), -1, units], "summed_layer")
    return values


def _add_last_layer(
    graph: GraphBuilder, values: str, layers: dict[int, np.ndarray], partition_indices: list[int]
) -> Coefficients:
    """Add the last layers.

    Args:
        values: name of the (L, N, H) values of the hidden units.
        layers: (H, K) weights of each last layer, by the index of its part.
        partition_indices: index of the partition of each part.
    """
    component_counts, units = [weights.shape[1] for weights in layers.values()], next(iter(layers.values())).shape[0]
    chunk_size = _chunk_size(component_counts, units, units)
    chunks, parts = _chunks(component_counts, chunk_size), list(layers)
    chunk_networks, weights = [network for network, _ in chunks], np.zeros((len(chunks), units, chunk_size))
    for index, (network, layer_slice) in enumerate(chunks):
        chunk_weights = layers[parts[network]][:, layer_slice]
        weights[index, :, : chunk_weights.shape[1]] = chunk_weights
    if len(chunks) > len(layers):
        values = graph.add("Gather", [values, graph.integers("chunk_owners", chunk_networks)], "chunk_hidden", axis=0)
    values = graph.add("MatMul", [values, graph.compact_floats("output_weights", weights)], "coefficients_by_chunk")
    values = graph.add("Transpose", [values], "coefficients", perm=[1, 0, 2])
    partitions = np.array([[partition_indices[parts[network]]] for network in chunk_networks])
    confidence = graph.integers("chunk_partitions", partitions)
    confidence = graph.add("Gather", [CONFIDENCE_OUTPUT, confidence], "chunk_confidence", axis=1)
    values = graph.add("Mul", [values, confidence], "scaled_coefficients")
    name = graph.reshape(values, [0, len(chunks) * chunk_size], "coefficient_row")
    return Coefficients(name, {part: chunk_size * chunk_networks.index(n) for n, part in enumerate(layers)})


def _first_layer(features: Features, prepared: TrainedPartition) -> tuple[np.ndarray, np.ndarray]:
    """Fold the standardization of the features into the first layer of a network.

    Returns:
        (Bn,) int64 indices of the vectors that are its inputs, and their (Bn, 3, H) float64 weights. The last vector is
        `Features.ones_vector`, whose elements are 1. The weight of its last element is the bias.
    """
    network, position = prepared.network, features.position[prepared.columns]
    vectors, vector_slots = np.unique(position // VECTOR_SIZE, return_inverse=True)
    weights = np.zeros((len(vectors) + 1, VECTOR_SIZE, network.weights[0].shape[1]))
    weights[vector_slots, position % VECTOR_SIZE] = (
        network.weights[0].astype(np.float64) / prepared.feature_scale[:, None]
    )
    # A feature may be far from 0 and vary little. So the bias has what compact weights take from the mean, and another
    # element what they take from the bias.
    rounded = np.multiply(*compact(weights))[vector_slots, position % VECTOR_SIZE]
    bias = network.biases[0] - prepared.feature_mean.astype(np.float64) @ rounded
    weights[-1, -1], weights[-1, 0] = bias, bias - np.multiply(*compact(bias))
    return np.append(vectors, features.ones_vector), weights


def _add_activation(graph: GraphBuilder, value: str, activation: str, output: str) -> str:
    if activation == "silu":
        return graph.add("Mul", [value, graph.add("Sigmoid", [value], f"{output}_sigmoid")], output)
    if activation == "gelu":
        scaled_value = graph.add("Mul", [value, graph.floats(f"{output}_root", np.sqrt(0.5))], f"{output}_scaled")
        error = graph.add("Erf", [scaled_value], f"{output}_erf")
        error_plus_one = graph.add("Add", [error, graph.floats(f"{output}_one", 1.0)], f"{output}_raised")
        half_value = graph.add("Mul", [value, graph.floats(f"{output}_half", 0.5)], f"{output}_halved")
        return graph.add("Mul", [half_value, error_plus_one], output)
    return graph.add({"tanh": "Tanh", "relu": "Relu"}[activation], [value], output)
