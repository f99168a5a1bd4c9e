# SPDX-License-Identifier: GPL-3.0-or-later
"""Reading of an untrusted ONNX file before a runtime loads it: its content, and the shapes of all its values.

ONNX Runtime opens external data files and loads custom operators while it reads a model, and Blender has no `onnx`
package. So the protobuf messages are read here (https://onnx.ai/onnx/repo-docs/IR.html, onnx.proto; wire format:
https://protobuf.dev/programming-guides/encoding/). A field or an operator that `train` does not write is refused, and a
graph whose values would fill the memory too. ONNX Runtime itself checks whether nodes, types and shapes match.
"""

import hashlib
import math
from collections import defaultdict
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

Shape = tuple[int, ...]

ALLOWED_FIELDS = {
    "ModelProto": {1, 2, 3, 4, 5, 6, 7, 8, 14},
    "OperatorSetIdProto": {1, 2},
    "StringStringEntryProto": {1, 2},
    "GraphProto": {1, 2, 5, 10, 11, 12, 13},
    "NodeProto": {1, 2, 3, 4, 5, 6, 7},
    "AttributeProto": {1, 2, 3, 8, 13, 20},
    "TensorProto": {1, 2, 8, 9, 12},
    "ValueInfoProto": {1, 2, 3},
    "TypeProto": {1},
    "TypeProto.Tensor": {1, 2},
    "TensorShapeProto": {1},
    "TensorShapeProto.Dimension": {1, 2},
}
"""Numbers of the fields that a model may have, by message."""
REFUSED_FIELD_LABELS = {
    ("ModelProto", 20): "a training of its own",
    ("ModelProto", 25): "functions of its own",
    ("GraphProto", 15): "sparse tensors",
    ("AttributeProto", 5): "tensors inside of nodes",
    **dict.fromkeys((("AttributeProto", 6), ("AttributeProto", 11)), "graphs inside of nodes"),
    **dict.fromkeys((("TensorProto", 13), ("TensorProto", 14)), "data in other files"),
}
ITEM_BYTES = {1: 4, 5: 2, 6: 4, 7: 8}
"""Bytes per element, by the number of the ONNX data type: float, int16, int32, int64."""
FLOAT, INT64 = 1, 7
"""Numbers of ONNX data types."""
MAX_CONSTANT_INTEGERS = 1 << 16
"""Largest number of elements of a constant whose integers are read; the longest one has the sizes of all partitions."""
SUPPORTED_OPSETS = range(13, 22)
"""Versions of the operator set in which the operators of models do not differ; ONNX Runtime 1.20 runs all of them."""
FREE_ELEMENTS = 1 << 20
"""Number of elements that the values of a graph may have beside one element per byte of the file, for each pose.

What depends on constants alone may have three times as many, because compact constants go through three nodes."""


class OnnxConstant(NamedTuple):
    """A constant of a graph: its ONNX data type, shape and bytes."""

    type: int
    shape: Shape
    data: memoryview


class OnnxNode(NamedTuple):
    """A node of a graph. Attributes are integers or lists of integers; other numbers are None."""

    operator: str
    inputs: list[str]
    outputs: list[str]
    attributes: dict[str, int | list[int] | None]


@dataclass
class OnnxContents:
    """Content of an ONNX file.

    Attributes:
        size: size of the file in bytes.
        inputs, outputs: shapes by name; a dimension is an int, or a str where it is dynamic.
        checksum: SHA-256 of the graph, hexadecimal.
    """

    size: int
    inputs: dict[str, tuple] = field(default_factory=dict)
    outputs: dict[str, tuple] = field(default_factory=dict)
    metadata: dict[str, str] = field(default_factory=dict)
    nodes: list[OnnxNode] = field(default_factory=list)
    constants: dict[str, OnnxConstant] = field(default_factory=dict)
    checksum: str = ""


def read_onnx(data: bytes) -> OnnxContents:
    """Read the content of an ONNX file from its bytes, without running it.

    Raises:
        ValueError: the bytes are no ONNX file, or it has content that `train` does not write. The message is a clause
            about the file.
    """
    contents = OnnxContents(len(data))
    try:
        model = _read_fields("ModelProto", memoryview(data))
        for opset in (_read_fields("OperatorSetIdProto", value) for value in model[8]):
            if _text(opset[1]) or not set(opset[2]) <= set(SUPPORTED_OPSETS):
                name = _text(opset[1]) or f"version {opset[2]}"
                raise ValueError(f"it has the operator set {name}, which train does not write")
        for entry in (_read_fields("StringStringEntryProto", value) for value in model[14]):
            contents.metadata[_text(entry[1])] = _text(entry[2])
        if not model[7]:
            raise ValueError("it is not an ONNX file")
        # Protobuf merges a message that is written twice.
        contents.checksum = hashlib.sha256(b"".join(model[7])).hexdigest()
        for graph in (_read_fields("GraphProto", value) for value in model[7]):
            contents.nodes += map(_read_node, graph[1])
            contents.inputs |= map(_read_shape, graph[11])
            contents.outputs |= map(_read_shape, graph[12])
            for name, constant in map(_read_constant, graph[5]):
                if name in contents.constants:
                    raise ValueError(f"it has two constants '{name}'")
                contents.constants[name] = constant
    except (IndexError, TypeError, UnicodeDecodeError) as error:
        raise ValueError("it is not an ONNX file") from error
    return contents


def _read_fields(message: str, data: memoryview) -> defaultdict[int, list]:
    """Read the fields of a protobuf message: for each number the values in their order, integers or bytes.

    A value of fixed width is None, because only the float of an attribute has one.
    """
    fields, position = defaultdict(list), 0
    while position < len(data):
        key, position = _read_varint(data, position)
        wire_type, number, value = key & 7, key >> 3, None
        if wire_type == 0:
            value, position = _read_varint(data, position)
        elif wire_type in (1, 5):
            position += 8 if wire_type == 1 else 4
        elif wire_type == 2:
            size, position = _read_varint(data, position)
            value, position = data[position : position + size], position + size
        # Other readers truncate a longer key to 32 bits. They would find a field that this reader does not.
        if wire_type in (3, 4, 6, 7) or position > len(data) or key >> 32:
            raise ValueError("it is not an ONNX file")
        if number not in ALLOWED_FIELDS[message]:
            label = REFUSED_FIELD_LABELS.get((message, number), f"a {message} with the field {number}")
            is_onnx = message != "ModelProto" or (message, number) in REFUSED_FIELD_LABELS
            raise ValueError(f"it has {label}, which train does not write" if is_onnx else "it is not an ONNX file")
        fields[number].append(value)
    return fields


def _read_varint(data: memoryview, position: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        byte = data[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position
    raise ValueError("it is not an ONNX file")


def _text(values: list) -> str:
    """Return the text of a field that may be missing or repeated; the last one counts."""
    texts = [str(memoryview(value), "utf-8") for value in values]
    return texts[-1] if texts else ""


def _integers(values: list) -> list[int]:
    """Return the signed integers of a repeated field, whose values are single integers or packed lists."""
    integers = []
    for value in values:
        if isinstance(value, int):
            integers.append(value)
            continue
        if len(value) > MAX_CONSTANT_INTEGERS:
            raise ValueError(f"it has a list of {len(value)} bytes, which train does not write")
        position = 0
        while position < len(value):
            integer, position = _read_varint(value, position)
            integers.append(integer)
    return [integer - (1 << 64) if integer >> 63 else integer for integer in integers]


def _read_node(data: memoryview) -> OnnxNode:
    node = _read_fields("NodeProto", data)
    attributes = {}
    for attribute in (_read_fields("AttributeProto", value) for value in node[5]):
        integers = _integers(attribute[8])
        attributes[_text(attribute[1])] = integers or (_integers(attribute[3])[-1] if attribute[3] else None)
    operator = f"{_text(node[7])}::{_text(node[4])}" if _text(node[7]) else _text(node[4])
    return OnnxNode(operator, [_text([name]) for name in node[1]], [_text([name]) for name in node[2]], attributes)


def _read_constant(data: memoryview) -> tuple[str, OnnxConstant]:
    tensor = _read_fields("TensorProto", data)
    name, shape = _text(tensor[8]), tuple(_integers(tensor[1]))
    element_type, content = (values[-1] if values else b"" for values in (tensor[2], tensor[9]))
    if min(shape, default=0) < 0 or math.prod(shape) * ITEM_BYTES.get(element_type, 0) != len(content):
        raise ValueError(f"it has a constant '{name}' whose size is not that of its type and shape")
    if element_type not in ITEM_BYTES:
        raise ValueError(f"it has a constant '{name}' of another type than numbers")
    return name, OnnxConstant(element_type, shape, content)


def _read_shape(data: memoryview) -> tuple[str, tuple]:
    """Read the name and the shape of an input or output; an unnamed dynamic dimension is "?"."""
    value = _read_fields("ValueInfoProto", data)
    messages = value[2]
    for message, number in (("TypeProto", 1), ("TypeProto.Tensor", 2), ("TensorShapeProto", 1)):
        messages = [inner for outer in messages for inner in _read_fields(message, outer)[number]]
    dimensions = [_read_fields("TensorShapeProto.Dimension", dimension) for dimension in messages]
    return _text(value[1]), tuple(d[1][-1] if d[1] else _text(d[2]) or "?" for d in dimensions)


def infer_shapes(contents: OnnxContents, input_shapes: dict[str, Shape], pose_count: int) -> dict[str, Shape]:
    """Compute the shapes of all values of a graph, which bound the memory of a run.

    Only the sizes of valid nodes have to be right, because ONNX Runtime refuses the others. To support another
    operator, add it to `_output_shapes`.

    Args:
        contents: content of the file.
        input_shapes: shapes of the inputs, by name.
        pose_count: number of poses, the first dimension of each input.

    Returns:
        Shapes of inputs, constants and outputs of nodes, by name.

    Raises:
        ValueError: an operator is not one that `train` writes, a node is damaged, or the values have more elements than
            the size of the file explains. The message is a clause about the file.
    """
    shapes = input_shapes | {name: constant.shape for name, constant in contents.constants.items()}
    # ONNX Runtime computes what depends on constants alone once, while it loads the graph.
    once, elements = set(contents.constants), {True: 0, False: 0}
    for node in contents.nodes:
        inputs = [name for name in node.inputs if name]
        if missing := [name for name in inputs if name not in shapes]:
            raise ValueError(f"a {node.operator} takes {missing[0]!r}, which nothing gives")
        constants = [contents.constants.get(name) for name in inputs]
        try:
            output_shapes = _output_shapes(node, [shapes[name] for name in inputs], constants)
        except (IndexError, TypeError, ZeroDivisionError) as error:
            raise ValueError(f"it has a damaged {node.operator}") from error
        is_once = once.issuperset(inputs)
        once.update(node.outputs if is_once else ())
        elements[is_once] += sum(map(math.prod, output_shapes))
        if max(elements[True] / 3, elements[False] / pose_count) > contents.size + FREE_ELEMENTS:
            raise ValueError(f"it computes more numbers for {pose_count} poses than its {contents.size} bytes explain")
        for name, shape in zip(node.outputs, output_shapes, strict=False):
            if name in shapes:
                raise ValueError(f"it has two values '{name}'")
            shapes[name] = shape
    return shapes


def _output_shapes(node: OnnxNode, shapes: list[Shape], constants: list[OnnxConstant | None]) -> list[Shape]:
    """Compute the shapes of the outputs of a node (https://onnx.ai/onnx/operators/)."""

    def integers(index: int) -> list[int]:
        if constants[index] is None or constants[index].type != INT64:
            raise ValueError(f"it has a {node.operator} whose sizes are no constants, which train does not write")
        return np.frombuffer(constants[index].data, np.int64).tolist()

    attributes, shape = node.attributes, shapes[0]
    match node.operator:
        # Texts, for example, would take many times the memory of floats.
        case "Cast" if attributes.get("to") == FLOAT:
            return [shape]
        case "Relu" | "Sigmoid" | "Tanh" | "Erf" | "Sqrt":
            return [shape]
        case "Add" | "Sub" | "Mul" | "Div" | "Max" | "Min":
            return [np.broadcast_shapes(*shapes)]
        case "MatMul":
            return [(*np.broadcast_shapes(shape[:-2], shapes[1][:-2]), shape[-2], shapes[1][-1])]
        case "Gemm":
            rows = shape[1 if attributes.get("transA") else 0]
            return [(rows, shapes[1][0 if attributes.get("transB") else 1])]
        case "Transpose":
            return [tuple(shape[axis] for axis in attributes.get("perm", range(len(shape))[::-1]))]
        case "Reshape":
            new_shape = [shape[i] if size == 0 else size for i, size in enumerate(integers(1))]
            if -1 in new_shape:
                new_shape[new_shape.index(-1)] = math.prod(shape) // -math.prod(new_shape)
            return [tuple(new_shape)]
        case "Concat" | "Split" | "Gather":
            axis = attributes.get("axis", 0) % len(shape)
            before, after = shape[:axis], shape[axis + 1 :]
            if node.operator == "Gather":
                return [(*before, *shapes[1], *after)]
            sizes = [sum(other[axis] for other in shapes)] if node.operator == "Concat" else integers(1)
            return [(*before, size, *after) for size in sizes]
        case "Slice":
            starts, ends, *others = (integers(index) for index in range(1, len(shapes)))
            axes, steps = others + [range(len(starts)), [1] * len(starts)][len(others) :]
            sizes = list(shape)
            for start, end, axis, step in zip(starts, ends, axes, steps, strict=True):
                sizes[axis] = len(range(*slice(start, end, step).indices(sizes[axis])))
            return [tuple(sizes)]
        case "ReduceSum":
            axes = {axis % len(shape) for axis in integers(1)}
            keeps = attributes.get("keepdims", 1)
            return [tuple(1 if axis in axes else size for axis, size in enumerate(shape) if keeps or axis not in axes)]
    raise ValueError(f"it has the operator {node.operator[:100]!r}, which train does not write")
