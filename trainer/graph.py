# SPDX-License-Identifier: GPL-3.0-or-later
"""The model's ONNX graph: from pose matrices to positions and trust, in standard operators.

Sections 3 to 5 of docs/model.md describe the tensors. N poses, J joints, P partitions, V vertices.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from fdda_addon.core.features import FEATURES_PER_JOINT
from fdda_addon.core.model import POSE_INPUT, POSITIONS_OUTPUT, TRUST_OUTPUT
from fdda_addon.core.partition import Partition
from fdda_addon.core.rig import Rig
from fdda_addon.core.skinning import SkinBlock

from .data import PreparedPartition
from .inputs import InputRows
from .loop import Network
from .trust import TrustRange

OPSET = 17
IR_VERSION = 8
"""Old enough for ONNX Runtime 1.17."""
SMALLEST_DETERMINANT = 1e-18
"""Added to determinants: a parent joint that is scaled to nothing gives large features, not NaN, and so no trust."""


@dataclass(frozen=True)
class Deformation:
    """Everything that the graph is built of.

    Attributes:
        rig: with J joints.
        partitions: P of them, with the prepared data and the network of each.
        inputs: what the networks see.
        trust: range of the training poses.
        activation: of the networks.
    """

    rig: Rig
    partitions: tuple[Partition, ...]
    inputs: InputRows
    prepared: tuple[PreparedPartition, ...]
    networks: tuple[Network, ...]
    trust: TrustRange
    activation: str


class _Graph:
    """Nodes and constants, named as they are added."""

    def __init__(self):
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, name: str, value: np.ndarray) -> str:
        self.constants.append(numpy_helper.from_array(np.ascontiguousarray(value), name))
        return name

    def floats(self, name: str, value: np.ndarray) -> str:
        return self.constant(name, np.asarray(value, np.float32))

    def integers(self, name: str, value: np.ndarray) -> str:
        return self.constant(name, np.asarray(value, np.int64))

    def add(self, operator: str, inputs: list[str], output: str, **attributes) -> str:
        self.nodes.append(helper.make_node(operator, inputs, [output], name=output, **attributes))
        return output

    def split(self, value: str, sizes: list[int], outputs: list[str], axis: int) -> list[str]:
        sizes_name = self.integers(f"{outputs[0]}_sizes", sizes)
        self.nodes.append(
            helper.make_node("Split", [value, sizes_name], outputs, name=f"{outputs[0]}_split", axis=axis)
        )
        return outputs


def build_graph(deformation: Deformation) -> onnx.ModelProto:
    """Build the model, without metadata."""
    graph = _Graph()
    joints, vertices = len(deformation.rig.joints), deformation.rig.vertex_count
    features = _features(graph, deformation.rig, deformation.inputs)
    inputs, trust = _range(graph, features, deformation)
    coefficients = _networks(graph, inputs, deformation)
    _playback(graph, coefficients, trust, deformation)
    inputs_info = [helper.make_tensor_value_info(POSE_INPUT, TensorProto.FLOAT, ["N", joints, 4, 4])]
    outputs_info = [
        helper.make_tensor_value_info(POSITIONS_OUTPUT, TensorProto.FLOAT, ["N", vertices, 3]),
        helper.make_tensor_value_info(TRUST_OUTPUT, TensorProto.FLOAT, ["N", len(deformation.partitions)]),
    ]
    proto = helper.make_graph(graph.nodes, "deformation", inputs_info, outputs_info, graph.constants)
    model = helper.make_model(proto, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="fdda")
    model.ir_version = IR_VERSION
    return model


def _features(graph: _Graph, rig: Rig, inputs: InputRows) -> str:
    """(N, R * 12) features Q^-1 P_j, where Q = P_r B_r^-1 B_j is the joint carried along by its reference."""
    parents, rest = inputs.references, rig.rest_matrices.astype(np.float64)[inputs.joints]
    carried = np.where(
        (parents >= 0)[:, None, None],
        np.linalg.inv(rig.rest_matrices.astype(np.float64)[np.maximum(parents, 0)]) @ rest,
        np.zeros((4, 4)),
    )
    roots = np.where((parents < 0)[:, None, None], rest, np.zeros((4, 4)))
    count = len(parents)
    above = graph.add("Gather", [POSE_INPUT, graph.integers("parents", np.maximum(parents, 0))], "above", axis=1)
    moved = graph.add("MatMul", [above, graph.floats("rest_to_parent", carried)], "moved")
    carried_by = graph.add("Add", [moved, graph.floats("root_rest", roots)], "carried")
    posed = graph.add("Gather", [POSE_INPUT, graph.integers("posed_joints", inputs.joints)], "posed", axis=1)
    flat = graph.integers("flat_matrix", [0, count, 16])
    both = graph.add(
        "Concat",
        [
            graph.add("Reshape", [posed, flat], "pose_flat"),
            graph.add("Reshape", [carried_by, flat], "carried_flat"),
        ],
        "pose_and_carried",
        axis=2,
    )
    picked = graph.add("MatMul", [both, graph.floats("picks", _picks())], "picked")
    left, right, column, offsets = graph.split(picked, [18, 18, 3, 12], ["left", "right", "column", "offsets"], axis=2)
    # Adjugate by products of pairs: the difference of the first nine and the last nine.
    signs = np.concatenate([np.eye(9), -np.eye(9)])
    products = graph.add("Mul", [left, right], "minors")
    adjugate = graph.add("MatMul", [products, graph.floats("minor_signs", signs)], "adjugate")
    first = graph.add(
        "Slice",
        [adjugate, *(graph.integers(f"first_{k}", [v]) for k, v in (("start", 0), ("end", 3), ("axis", 2)))],
        "adjugate_row",
    )
    expansion = graph.add("Mul", [first, column], "expansion")
    axis = graph.integers("last_axis", [2])
    determinant = graph.add("ReduceSum", [expansion, axis], "determinant", keepdims=1)
    safe = graph.add("Add", [determinant, graph.floats("smallest", SMALLEST_DETERMINANT)], "safe_determinant")
    inverse = graph.add("Div", [adjugate, safe], "inverse_flat")
    inverse = graph.add("Reshape", [inverse, graph.integers("as_3x3", [0, count, 3, 3])], "inverse")
    offsets = graph.add("Reshape", [offsets, graph.integers("as_3x4", [0, count, 3, 4])], "offsets_3x4")
    relative = graph.add("MatMul", [inverse, offsets], "relative")
    return graph.add("Reshape", [relative, graph.integers("as_features", [0, count * FEATURES_PER_JOINT])], "features")


def _picks() -> np.ndarray:
    """(32, 51): from the elements of P_j and Q_j, the factors of the minors of Q_j, its first column, and P_j - t.

    A product with ones and zeros is exact, and faster than gathering elements one by one.
    """
    picks = np.zeros((32, 51))
    element = np.arange(9).reshape(3, 3)
    for i, j in np.ndindex(3, 3):
        r1, r2, c1, c2 = (j + 1) % 3, (j + 2) % 3, (i + 1) % 3, (i + 2) % 3
        for half, (a, b) in enumerate((((r1, c1), (r2, c2)), ((r1, c2), (r2, c1)))):
            picks[16 + 4 * a[0] + a[1], element[i, j] + 9 * half] = 1
            picks[16 + 4 * b[0] + b[1], 18 + element[i, j] + 9 * half] = 1
    for row in range(3):
        picks[16 + 4 * row, 36 + row] = 1
        for column in range(4):
            picks[4 * row + column, 39 + 4 * row + column] = 1
        picks[16 + 4 * row + 3, 39 + 4 * row + 3] = -1
    return picks


def _range(graph: _Graph, features: str, deformation: Deformation) -> tuple[str, str]:
    """Clamp the features to the training range.

    Returns:
        (N, R * 12) standardised features, clamped; (N, P + 1) trust, the last column always 1.
    """
    trust = deformation.trust
    joints = len(deformation.rig.joints)
    mean, scale = standardisation(deformation)
    low, high = ((bound.ravel() - mean) / scale for bound in (trust.low, trust.high))
    centred = graph.add("Sub", [features, graph.floats("feature_mean", mean)], "centred")
    standard = graph.add("Mul", [centred, graph.floats("feature_scale", 1 / scale)], "standard")
    raised = graph.add("Max", [standard, graph.floats("range_low", low)], "raised")
    clamped = graph.add("Min", [raised, graph.floats("range_high", high)], "clamped")
    outside = graph.add("Sub", [standard, clamped], "outside")
    own = joints * FEATURES_PER_JOINT
    if len(scale) > own:
        bounds = (graph.integers(f"joint_features_{k}", [v]) for k, v in (("start", 0), ("end", own), ("axis", 1)))
        outside = graph.add("Slice", [outside, *bounds], "joints_outside")
    excess = graph.add("Mul", [outside, graph.floats("per_fade_width", scale[:own] / trust.width.ravel())], "excess")
    squared = graph.add("Mul", [excess, excess], "excess_squared")
    counts = np.zeros((joints, FEATURES_PER_JOINT, len(deformation.partitions) + 1))
    counts[:, :, :-1] = trust.counts.T[:, None, :]
    summed = graph.add(
        "MatMul", [squared, graph.floats("counts", counts.reshape(-1, counts.shape[2]))], "partition_excess"
    )
    left = graph.add("Sub", [graph.floats("one", 1.0), summed], "trust_left")
    root = graph.add("Relu", [left], "trust_root")
    both = graph.add("Mul", [root, root], "trust_and_one")
    graph.add(
        "Slice",
        [both, *(graph.integers(f"trust_{k}", [v]) for k, v in (("start", 0), ("end", -1), ("axis", 1)))],
        TRUST_OUTPUT,
    )
    return clamped, both


def standardisation(deformation: Deformation) -> tuple[np.ndarray, np.ndarray]:
    """(R * 12,) float64 mean and scale of each feature; 0 and 1 where no partition looks at it."""
    size = len(deformation.inputs.joints) * FEATURES_PER_JOINT
    mean, scale = np.zeros(size), np.ones(size)
    for number, prepared in enumerate(deformation.prepared):
        columns = deformation.inputs.columns(number)[prepared.columns]
        mean[columns], scale[columns] = prepared.feature_mean, prepared.feature_scale
    return mean, scale


def _networks(graph: _Graph, inputs: str, deformation: Deformation) -> str:
    """(N, P * (K + 1)) coefficients in metres, padded; the last of each partition is 1, for the mean."""
    count = len(deformation.partitions)
    learned = [n for n, network in enumerate(deformation.networks) if len(network.biases[-1])]
    layers = max((len(network.weights) for network in deformation.networks), default=1)
    widths = [max((len(deformation.networks[n].biases[layer]) for n in learned), default=0) for layer in range(layers)]
    widths[-1] += 1
    columns = np.zeros((count, max((len(p.columns) for p in deformation.prepared), default=0) or 1), np.int64)
    sizes = [columns.shape[1], *widths]
    weights = [np.zeros((count, a, b), np.float32) for a, b in pairwise(sizes)]
    biases = [np.zeros((count, 1, b), np.float32) for b in widths]
    biases[-1][:, 0, -1] = 1
    for n in learned:
        own = deformation.inputs.columns(n)[deformation.prepared[n].columns]
        columns[n, : len(own)] = own
        for layer, (weight, bias) in enumerate(
            zip(deformation.networks[n].weights, deformation.networks[n].biases, strict=True)
        ):
            weights[layer][n, : weight.shape[0], : weight.shape[1]] = weight
            biases[layer][n, 0, : len(bias)] = bias
    seen = graph.add("Gather", [inputs, graph.integers("seen_columns", columns)], "seen", axis=1)
    values = graph.add("Transpose", [seen], "network_inputs", perm=[1, 0, 2])
    for layer, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        values = graph.add("MatMul", [values, graph.floats(f"weights_{layer}", weight)], f"product_{layer}")
        values = graph.add("Add", [values, graph.floats(f"biases_{layer}", bias)], f"layer_{layer}")
        if layer < layers - 1:
            values = _activation(graph, values, deformation.activation, f"hidden_{layer}")
    by_pose = graph.add("Transpose", [values], "coefficients_by_pose", perm=[1, 0, 2])
    return graph.add("Reshape", [by_pose, graph.integers("as_row", [0, count * widths[-1]])], "coefficients")


def _activation(graph: _Graph, value: str, activation: str, output: str) -> str:
    if activation == "silu":
        return graph.add("Mul", [value, graph.add("Sigmoid", [value], f"{output}_sigmoid")], output)
    if activation == "gelu":
        scaled = graph.add("Mul", [value, graph.floats(f"{output}_root", np.sqrt(0.5))], f"{output}_scaled")
        error = graph.add("Erf", [scaled], f"{output}_erf")
        raised = graph.add("Add", [error, graph.floats(f"{output}_one", 1.0)], f"{output}_raised")
        halved = graph.add("Mul", [value, graph.floats(f"{output}_half", 0.5)], f"{output}_halved")
        return graph.add("Mul", [halved, raised], output)
    return graph.add({"tanh": "Tanh", "relu": "Relu"}[activation], [value], output)


def _playback(graph: _Graph, coefficients: str, trust: str, deformation: Deformation) -> None:
    """Positions as one product with a constant matrix for each partition.

    The rows of partition p are [ P_j of the joints that skin it | t c_k P_m | t P_m ], of its main joint m; its matrix
    [ w_vj B_j^-1 (x_v, 1) | shape_k and mean, turned by B_m^-1 ]: the inverse rest matrices are in the constants.
    """
    rig, count = deformation.rig, len(deformation.partitions)
    inverse_rest = np.linalg.inv(rig.rest_matrices.astype(np.float64))
    padded = max((len(network.biases[-1]) for network in deformation.networks), default=0) + 1
    sizes, pose_columns, coefficient_columns, trust_columns, matrices = [], [], [], [], []
    for number, (partition, prepared) in enumerate(zip(deformation.partitions, deformation.prepared, strict=True)):
        block = SkinBlock(rig, partition)
        skin = np.einsum(
            "jab,jbv->jav",
            inverse_rest[block.joints],
            block.weighted_rest.reshape(len(block.joints), 4, -1).astype(np.float64),
        )
        shapes = np.concatenate([prepared.basis.shapes, prepared.basis.mean[None]]).astype(np.float64)
        turned = np.einsum("ab,kvb->akv", inverse_rest[partition.joint, :3, :3], shapes.reshape(len(shapes), -1, 3))
        own = [*range(number * padded, number * padded + len(shapes) - 1), (number + 1) * padded - 1]
        matrices.append(np.concatenate([skin.reshape(-1, skin.shape[2]), turned.reshape(-1, turned.shape[2])]))
        linear = 4 * len(block.joints)
        pose_columns += [4 * joint + column for joint in block.joints for column in range(4)]
        pose_columns += [4 * partition.joint + axis for axis in range(3) for _ in own]
        coefficient_columns += [own[-1]] * linear + own * 3
        trust_columns += [count] * linear + [number] * (3 * len(own))
        sizes.append(linear + 3 * len(own))
    width = len(pose_columns)
    flat = graph.add("Reshape", [POSE_INPUT, graph.integers("as_row_of_poses", [0, 16 * len(rig.joints)])], "pose_row")
    # Column c of a joint's matrix stands four elements apart; a joint's matrix sixteen.
    joint, column = np.divmod(np.array(pose_columns), 4)
    elements = 16 * joint + column + 4 * np.arange(3)[:, None]
    poses = graph.add("Gather", [flat, graph.integers("pose_elements", elements)], "row_poses", axis=1)
    factors = [
        graph.add("Gather", [source, graph.integers(f"{name}_columns", np.reshape(columns, (1, width)))], name, axis=1)
        for source, name, columns in (
            (coefficients, "row_coefficients", coefficient_columns),
            (trust, "row_trust", trust_columns),
        )
    ]
    rows = graph.add("Mul", [poses, graph.add("Mul", factors, "factors")], "rows")
    parts = [rows]
    if count > 1:
        parts = graph.split(rows, sizes, [f"rows_{number}" for number in range(count)], axis=2)
    blocks = [
        graph.add("MatMul", [part, graph.floats(f"matrix_{number}", matrix)], f"block_{number}")
        for number, (part, matrix) in enumerate(zip(parts, matrices, strict=True))
    ]
    joined = graph.add("Concat", blocks, "blocks", axis=2)
    order = np.argsort(np.concatenate([p.vertices for p in deformation.partitions]))
    by_vertex = graph.add("Transpose", [joined], "positions_by_partition", perm=[0, 2, 1])
    graph.add("Gather", [by_vertex, graph.integers("vertex_order", order)], POSITIONS_OUTPUT, axis=1)
