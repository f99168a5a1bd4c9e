# SPDX-License-Identifier: GPL-3.0-or-later
"""Check that the graph of a model has only operators that `train` writes, and a cost that its metadata explains.

The cost of loading and running a graph is bounded before a runtime loads it. The bounds are several times the largest
known cost, to permit other graphs for the same deformation.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from .features import FEATURES_PER_JOINT
from .onnx_cost import GraphCost, Shape, compute_graph_cost
from .onnx_file import ITEM_BYTES, OnnxContents

INPUT_ITEM_NAMES = {3: "joints", 1: "controls"}
"""Names of the things that the first dimension of an input counts, by rank of the shape."""
COST_FACTOR = 8
"""Largest cost of a graph, as a multiple of its budget."""
FREE_ELEMENTS = 1 << 16
"""Number of elements that every graph may have in addition to its budget."""
MAX_NODES = 20_000
BASE_NODES, NODES_PER_PARTITION = 256, 32
BATCH_POSES = 32
"""Number of poses for which the cost is computed again: it must not grow faster than the number of poses."""
DEFAULT_HIDDEN_UNITS = [128, 128]
MAX_HIDDEN_LAYERS = 16
MAX_LAYER_UNITS = 1 << 16


@dataclass(frozen=True)
class Budget:
    """Numbers of elements that the metadata of a model explains, for one pose.

    Attributes:
        values: elements of the outputs of all nodes.
        constants: elements of the constants.
    """

    values: int
    constants: int


def compute_budget(joints: int, controls: int, partitions: Sequence[tuple[int, int, int]], training: dict) -> Budget:
    """Compute the budget of a character's model.

    Args:
        joints, controls: numbers of joints and of controls.
        partitions: for each partition the numbers of its vertices, its components, and its influencing joints and
            controls.
        training: settings of the training in the metadata.

    Raises:
        ValueError: the settings are invalid; the text is a clause about the model.
    """
    vertex_counts, component_counts, input_counts = map(list, zip(*partitions, strict=True))
    # Features of joints relative to their parents, and relative to the main joints of partitions.
    features = 16 * joints + 3 * controls + 3 * sum(input_counts)
    layer_units = [(FEATURES_PER_JOINT + 3) * max(input_counts), *_read_hidden_units(training), max(component_counts)]
    network_weights = sum(inputs * outputs for inputs, outputs in pairwise(layer_units))
    matrix_elements = 4 * (joints + sum(count + 2 * joints for count in component_counts))
    values = (
        3 * sum(vertex_counts)
        + 4 * features
        + len(partitions) * (sum(layer_units) + 9 * max(component_counts))
        + 3 * matrix_elements
    )
    partition_matrices = sum(vertices * (8 * joints + 3 * components) for vertices, components, _ in partitions)
    constants = (
        partition_matrices + len(partitions) * (network_weights + sum(layer_units) + 2 * features) + 4 * features
    )
    return Budget(values, constants)


def _read_hidden_units(training: dict) -> list[int]:
    """Read the number of units of each hidden layer."""
    layer_units = training.get("hidden", DEFAULT_HIDDEN_UNITS)
    if not isinstance(layer_units, list) or len(layer_units) > MAX_HIDDEN_LAYERS:
        raise ValueError("its networks have hidden layers that are none")
    if not all(type(units) is int and 0 < units <= MAX_LAYER_UNITS for units in layer_units):
        raise ValueError("its networks have hidden layers that are none")
    return layer_units


def check_inputs_and_outputs(contents: OnnxContents, inputs: dict[str, Shape], outputs: dict[str, Shape]) -> None:
    """Check that inputs and outputs of a graph match its metadata.

    Args:
        contents: contents of the file.
        inputs, outputs: expected shapes without the dimension of poses, by name; only the first output is required.

    Raises:
        ValueError: the check fails; the message is a clause about the graph.
    """
    for name, shape in inputs.items():
        if contents.inputs.get(name, ())[1:] != shape:
            raise ValueError(f"its input '{name}' does not fit its {shape[0]} {INPUT_ITEM_NAMES[len(shape)]}")
    first_output, shape = next(iter(outputs.items()))
    if contents.outputs.get(first_output, ())[1:] != shape:
        raise ValueError(f"its output '{first_output}' does not fit its {shape[0]} vertices")


def check_graph(
    contents: OnnxContents, budget: Budget, size: int, outputs: dict[str, Shape], partition_count: int
) -> None:
    """Check that a graph has only what `train` writes, and costs no more than its metadata explains.

    Args:
        contents: contents of the file.
        budget: budget from the metadata of the model.
        size: size of the file in bytes.
        outputs: shapes of the outputs without the dimension of poses, by name.
        partition_count: number of partitions of the model.

    Raises:
        ValueError: the check fails; the message is a clause about the graph.
    """
    if contents.unsupported:
        raise ValueError(f"it has {contents.unsupported[0]}, which train does not write")
    if budget.values > 2 * size + 16 * FREE_ELEMENTS:
        raise ValueError(f"its metadata tells of a character that {size} bytes cannot hold")
    if len(contents.nodes) > min(MAX_NODES, BASE_NODES + NODES_PER_PARTITION * partition_count):
        raise ValueError(f"it has {len(contents.nodes)} nodes, more than its {partition_count} partitions explain")
    constant_bytes = sum(len(constant.data) for constant in contents.constants.values())
    if constant_bytes > ITEM_BYTES[1] * COST_FACTOR * (budget.constants + FREE_ELEMENTS):
        raise ValueError(
            f"its constants have {constant_bytes} bytes, more than its joints, vertices and components explain"
        )
    single_cost, batch_cost = (compute_graph_cost(contents, poses) for poses in (1, BATCH_POSES))
    _check_cost(single_cost, budget, size, 1)
    _check_cost(batch_cost, budget, size, BATCH_POSES)
    for name, shape in outputs.items():
        for cost, poses in ((single_cost, 1), (batch_cost, BATCH_POSES)):
            if name in contents.outputs and cost.shapes.get(name) != (poses, *shape):
                raise ValueError(f"its output '{name}' comes out as {cost.shapes.get(name)}, not as {(poses, *shape)}")


def _check_cost(cost: GraphCost, budget: Budget, size: int, poses: int) -> None:
    if cost.elements > COST_FACTOR * poses * (budget.values + FREE_ELEMENTS):
        raise ValueError(
            f"it computes {cost.elements} numbers for {poses} poses, more than its joints, vertices and components "
            "explain"
        )
    # A constant is used once per pose and axis.
    if cost.products > COST_FACTOR * poses * (size + 64 * (budget.values + FREE_ELEMENTS)):
        raise ValueError(f"it multiplies {cost.products} numbers for {poses} poses, more than its size explains")
