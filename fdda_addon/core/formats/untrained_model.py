# SPDX-License-Identifier: GPL-3.0-or-later
"""Writes a model that is not trained: linear skinning, and networks of the usual size that add nothing.

It reads, computes and writes as much as a trained model of the same rig, so its frames take as long. The `onnx` package
writes trained models, but Blender lacks it; so the protobuf messages are written here (`onnx_file` reads them).
"""

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np

from ..mathematics.partition import Partition, make_merged_partitions
from ..mathematics.skinning import SkinBlock
from ..rig import STATIC_JOINT, Rig
from .model import CHECKSUM_KEY, CONFIDENCE_OUTPUT, CONTROLS_INPUT, METADATA_KEY, POSE_INPUT, POSITIONS_OUTPUT
from .model_info import ModelInfo, ModelPartition
from .onnx_file import FLOAT, INT64

OPSET, IR_VERSION = 17, 8
HIDDEN_UNITS = 64
COMPONENTS, FIT_JOINTS, INFLUENCING_JOINTS = 12, 8, 6
"""Typical numbers of a body part of a trained model: components, joints of its linear fit, joints that it reads."""
MAX_ROWS, RANK = 256, 128
"""The constants of a body part with more rows are two factors of this rank, as in a trained model."""


def build_untrained_model(rig: Rig, key_distances: Mapping[str, np.ndarray]) -> bytes:
    """Build the bytes of an untrained model.

    Args:
        rig: the rig, with the controls that a model would read. The vertices of a mesh without skin weights follow the
            nearest joints.
        key_distances: (V,) distances by which each shape key moves the vertices, by the name of its control.
    """
    skinned = _with_skin_weights(rig)
    partitions = make_merged_partitions(skinned)
    graph = _Graph()
    _add_deformation(graph, skinned, partitions, key_distances)
    inputs = [(POSE_INPUT, (len(rig.joints), 4, 4))]
    if rig.controls:
        inputs.append((CONTROLS_INPUT, (len(rig.controls),)))
    outputs = [(POSITIONS_OUTPUT, (rig.vertex_count, 3)), (CONFIDENCE_OUTPUT, (len(partitions),))]
    content = graph.to_bytes(inputs, outputs)
    controls = tuple(range(len(rig.controls)))
    low, high = (np.full((len(rig.joints), 12), bound, np.float32) for bound in (-1, 1))
    info = ModelInfo(
        joints=rig.joints,
        rest_matrices=rig.rest_matrices,
        meshes=rig.meshes,
        partitions=tuple(
            ModelPartition(p.joint, (), len(p.vertices), COMPONENTS, controls, p.merged) for p in partitions
        ),
        feature_low=low,
        feature_high=high,
        controls=rig.controls,
        metres_per_unit=rig.metres_per_unit,
    )
    metadata = {CHECKSUM_KEY: hashlib.sha256(content).hexdigest(), METADATA_KEY: info.to_json()}
    return b"".join(
        [
            _integer(1, IR_VERSION),
            _bytes(7, content),
            _bytes(8, _text(1, "") + _integer(2, OPSET)),
            *(_bytes(14, _text(1, key) + _text(2, value)) for key, value in metadata.items()),
        ]
    )


def _with_skin_weights(rig: Rig) -> Rig:
    """Return a rig in which the vertices of meshes without weights on bones follow the nearest joint."""
    is_bone = np.array([name != STATIC_JOINT for name in rig.joint_names], bool)
    joints, weights, heads = rig.skin_joints.copy(), rig.skin_weights.copy(), rig.rest_matrices[is_bone][:, :3, 3]
    for mesh in rig.mesh_slices if is_bone.any() else ():
        if rig.follows_bones[mesh].any():
            continue
        for first in range(mesh.start, mesh.stop, 1000):
            part = slice(first, min(first + 1000, mesh.stop))
            distances = ((rig.rest_positions[part, None] - heads[None]) ** 2).sum(axis=2)
            joints[part], weights[part] = np.flatnonzero(is_bone)[distances.argmin(axis=1)][:, None], 0.0
            weights[part, 0] = 1.0
    return replace(rig, skin_joints=joints, skin_weights=weights)


def _add_deformation(
    graph: "_Graph", rig: Rig, partitions: tuple[Partition, ...], key_distances: Mapping[str, np.ndarray]
) -> None:
    """Add the nodes from the inputs to the outputs, in the order of `trainer.export.export.build_graph`."""
    joint_count, part_count = len(rig.joints), len(partitions)
    random = np.random.default_rng(0)
    parents = graph.integers("parents", np.maximum(rig.parents, 0))
    parents = graph.add("Gather", [POSE_INPUT, parents], "parent_poses", axis=1)
    relative = graph.add("MatMul", [parents, graph.floats("rest", rig.rest_matrices)], "relative_poses")
    features = graph.reshape(relative, [0, 16 * joint_count], "joint_features")
    if rig.controls:
        features = graph.add("Concat", [features, CONTROLS_INPUT], "features", axis=1)
    feature_count = 16 * joint_count + len(rig.controls)
    limit = np.full((1, feature_count), 10.0)
    clamped = graph.add("Max", [features, graph.floats("low", -limit)], "raised")
    clamped = graph.add("Min", [clamped, graph.floats("high", limit)], "clamped")
    outside = graph.add("Sub", [features, clamped], "outside")
    confidence = np.zeros((feature_count, part_count))
    confidence = graph.add("MatMul", [outside, graph.floats("confidence_weights", confidence)], "distance")
    graph.add("Sigmoid", [confidence], CONFIDENCE_OUTPUT)
    # The networks.
    input_count = 16 * INFLUENCING_JOINTS + len(rig.controls)
    # Each network reads the features of some joints, and all controls.
    control_columns = 16 * joint_count + np.arange(len(rig.controls))
    columns = [
        np.append((16 * p.joint + np.arange(16 * INFLUENCING_JOINTS)) % (16 * joint_count), control_columns)
        for p in partitions
    ]
    values = graph.add("Gather", [clamped, graph.integers("columns", np.array(columns))], "network_inputs", axis=1)
    values = graph.add("Transpose", [values], "inputs_by_network", perm=[1, 0, 2])
    for index, (inputs, outputs) in enumerate(pairwise((input_count, HIDDEN_UNITS, HIDDEN_UNITS, COMPONENTS))):
        weights = 1e-3 * random.standard_normal((part_count, inputs, outputs))
        values = graph.add("MatMul", [values, graph.floats(f"weights_{index}", weights)], f"layer_{index}")
        if outputs == HIDDEN_UNITS:
            sigmoid = graph.add("Sigmoid", [values], f"sigmoid_{index}")
            values = graph.add("Mul", [values, sigmoid], f"hidden_{index}")
    coefficients = graph.add("Transpose", [values], "coefficients", perm=[1, 0, 2])
    coefficients = graph.reshape(coefficients, [0, part_count * COMPONENTS], "coefficient_row")
    _add_products(graph, rig, partitions, coefficients, key_distances)


def _add_products(
    graph: "_Graph",
    rig: Rig,
    partitions: tuple[Partition, ...],
    coefficients: str,
    key_distances: Mapping[str, np.ndarray],
) -> None:
    """Add the products of constant matrices and rows: the columns of poses of joints, multiplied by scalars.

    The scalars are coefficients, the values of shape keys, the confidence, and 1.
    """
    pose_row = graph.reshape(POSE_INPUT, [0, 16 * len(rig.joints)], "pose_row")
    one = graph.add("Gather", [pose_row, graph.integers("last_element", np.array([15]))], "one", axis=1)
    scalars = [one, CONFIDENCE_OUTPUT, coefficients, *([CONTROLS_INPUT] if rig.controls else [])]
    scalars = graph.add("Concat", scalars, "scalars", axis=1)
    inverse_rest = np.linalg.inv(rig.rest_matrices.astype(np.float64))
    row_joints, row_scalars, matrices = [], [], []
    for index, part in enumerate(partitions):
        skin = SkinBlock(rig, part.joint, part.vertices)
        fit_joints = (part.joint + np.arange(min(FIT_JOINTS, len(rig.joints)))) % len(rig.joints)
        first_coefficient, first_control = 1 + len(partitions) + COMPONENTS * np.array([index, len(partitions)])
        distances = ((i, key_distances.get(control.name)) for i, control in enumerate(rig.controls))
        keys = [i for i, distance in distances if distance is not None and distance[part.vertices].any()]
        others = [*(first_coefficient + np.arange(COMPONENTS)), *(first_control + key for key in keys)]
        row_joints.append(np.concatenate([skin.joints, fit_joints, np.full(len(others), part.joint)]))
        row_scalars.append([0] * len(skin.joints) + [1 + index] * len(fit_joints) + others)
        weighted_rest = skin.weighted_rest.reshape(len(skin.joints), 4, -1)
        skin_rows = (inverse_rest[skin.joints] @ weighted_rest).reshape(-1, len(part.vertices))
        row_count, rank = 4 * len(row_joints[-1]), len(skin_rows) + RANK
        if row_count <= max(MAX_ROWS, rank):
            matrices.append([np.concatenate([skin_rows, np.zeros((row_count - len(skin_rows), len(part.vertices)))])])
        else:
            left = np.eye(row_count, len(skin_rows))
            factors = np.pad(left, ((0, 0), (0, RANK))), np.pad(skin_rows, ((0, RANK), (0, 0)))
            matrices.append(list(factors))
    factors = graph.integers("row_scalars", np.concatenate(row_scalars)[:, None])
    factors = graph.add("Gather", [scalars, factors], "factors", axis=1)
    factors = graph.add("MatMul", [factors, graph.floats("twelve_ones", np.ones((1, 12)))], "factors_of_rows")
    columns = graph.add("Transpose", [POSE_INPUT], "pose_columns", perm=[0, 1, 3, 2])
    bounds = [graph.integers(name, np.array([bound])) for name, bound in (("start", 0), ("end", 3), ("axis", 3))]
    columns = graph.add("Slice", [columns, *bounds], "affine_columns")
    columns = graph.reshape(columns, [0, len(rig.joints), 12], "column_rows")
    joints = graph.integers("row_joints", np.concatenate(row_joints))
    rows = graph.add("Mul", [graph.add("Gather", [columns, joints], "unscaled", axis=1), factors], "scaled")
    rows = graph.reshape(rows, [0, 4 * sum(map(len, row_joints)), 3], "rows")
    rows = graph.add("Transpose", [rows], "rows_by_axis", perm=[0, 2, 1])
    sizes = graph.integers("row_counts", np.array([4 * len(joints) for joints in row_joints]))
    blocks = [f"rows_{index}" for index in range(len(partitions))]
    graph.add("Split", [rows, sizes], *blocks, axis=2)
    for index, constants in enumerate(matrices):
        for number, matrix in enumerate(constants):
            name = f"block_{index}_{number}"
            blocks[index] = graph.add("MatMul", [blocks[index], graph.floats(f"{name}_matrix", matrix)], name)
    positions = graph.add("Concat", blocks, "blocks", axis=2)
    positions = graph.add("Transpose", [positions], "positions_by_part", perm=[0, 2, 1])
    order = np.argsort(np.concatenate([part.vertices for part in partitions]))
    graph.add("Gather", [positions, graph.integers("order", order)], POSITIONS_OUTPUT, axis=1)


class _Graph:
    """An ONNX graph that is built node by node."""

    def __init__(self) -> None:
        self._nodes: list[bytes] = []
        self._constants: list[bytes] = []

    def add(self, operator: str, inputs: list[str], *outputs: str, **attributes: int | list[int]) -> str:
        """Add a node, and return the name of its first output."""
        content = [*(_text(1, name) for name in inputs), *(_text(2, name) for name in outputs), _text(4, operator)]
        for name, value in attributes.items():
            is_list = isinstance(value, list)
            values = b"".join(_integer(8, item) for item in value) if is_list else _integer(3, value)
            content.append(_bytes(5, _text(1, name) + values + _integer(20, 7 if is_list else 2)))
        self._nodes.append(b"".join(content))
        return outputs[0]

    def floats(self, name: str, array: np.ndarray) -> str:
        """Add a constant of float32, and return its name."""
        return self._add_constant(name, FLOAT, np.asarray(array, np.float32))

    def integers(self, name: str, array: np.ndarray) -> str:
        """Add a constant of int64, and return its name."""
        return self._add_constant(name, INT64, np.asarray(array, np.int64))

    def reshape(self, value: str, shape: list[int], name: str) -> str:
        """Add a Reshape; a size of 0 keeps the size of the input."""
        return self.add("Reshape", [value, self.integers(f"{name}_shape", np.array(shape))], name)

    def to_bytes(self, inputs: list[tuple[str, tuple]], outputs: list[tuple[str, tuple]]) -> bytes:
        """Return the GraphProto; the first dimension of inputs and outputs is the number of poses."""
        parts = [*(_bytes(1, node) for node in self._nodes), _text(2, "deformation")]
        parts += [_bytes(5, constant) for constant in self._constants]
        for number, values in ((11, inputs), (12, outputs)):
            for name, shape in values:
                dimensions = _bytes(1, _text(2, "N")) + b"".join(_bytes(1, _integer(1, size)) for size in shape)
                tensor = _integer(1, FLOAT) + _bytes(2, dimensions)
                parts.append(_bytes(number, _text(1, name) + _bytes(2, _bytes(1, tensor))))
        return b"".join(parts)

    def _add_constant(self, name: str, data_type: int, array: np.ndarray) -> str:
        dimensions = b"".join(_integer(1, size) for size in array.shape)
        self._constants.append(dimensions + _integer(2, data_type) + _text(8, name) + _bytes(9, array.tobytes()))
        return name


def _varint(value: int) -> bytes:
    parts = bytearray()
    while value > 0x7F:
        parts.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*parts, value])


def _integer(number: int, value: int) -> bytes:
    """Encode a field with an integer of at least 0."""
    return _varint(number << 3) + _varint(int(value))


def _bytes(number: int, content: bytes) -> bytes:
    """Encode a field with bytes, such as a message."""
    return _varint(number << 3 | 2) + _varint(len(content)) + content


def _text(number: int, text: str) -> bytes:
    return _bytes(number, text.encode())
