# SPDX-License-Identifier: GPL-3.0-or-later
"""Reading of the content of an untrusted ONNX file without running it.

ONNX Runtime opens external data files and loads custom operators while it reads a model, and Blender has no `onnx`
package. So the few relevant protobuf fields are read here
(https://onnx.ai/onnx/repo-docs/IR.html, onnx.proto; wire format: https://protobuf.dev/programming-guides/encoding/).
"""

import hashlib
import math
from dataclasses import dataclass, field

from .onnx_fields import decode_text, iterate_fields, read_integers, to_signed

ITEM_BYTES = {1: 4, 6: 4, 7: 8}
"""Bytes per element, by the number of the ONNX data type: float, int32, int64."""
INT64 = 7
"""Number of the ONNX data type int64."""
MAX_DIMENSIONS = 8
MAX_CONSTANT_INTEGERS = 1 << 16
"""Largest number of elements of a constant whose integers are read; the longest one has the sizes of all partitions."""
MAX_ATTRIBUTE_LENGTH = 16
STANDARD_DOMAINS = ("", "ai.onnx")
SUPPORTED_OPSETS = range(13, 24)
"""Versions of the operator set between which the operators of models do not differ."""
MAX_DEPTH = 8
"""Largest depth of nested subgraphs that is read."""


@dataclass(frozen=True)
class OnnxConstant:
    """A constant of a graph: its ONNX data type, shape and bytes."""

    type: int
    shape: tuple[int, ...]
    data: memoryview

    def integers(self) -> tuple[int, ...]:
        """Return the elements of a short int64 constant; raise ValueError for other constants."""
        if self.type != INT64 or math.prod(self.shape) > MAX_CONSTANT_INTEGERS:
            raise ValueError("a shape is no list of whole numbers")
        item_bytes = ITEM_BYTES[INT64]
        return tuple(
            int.from_bytes(self.data[start : start + item_bytes], "little", signed=True)
            for start in range(0, len(self.data), item_bytes)
        )


@dataclass(frozen=True)
class OnnxNode:
    """A node of a graph. Attributes are integers, tuples of integers, or None for other types."""

    operator: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: dict[str, int | tuple[int, ...] | None]


@dataclass
class OnnxContents:
    """Content of an ONNX file.

    Attributes:
        inputs, outputs: shapes by name; a dimension is an int, or a str where it is dynamic.
        metadata: the metadata properties.
        custom_operators: operators outside the standard domains, "domain::name".
        external_files: files of external tensors; "" where the file is not named.
        nodes: nodes of the main graph, in their order.
        constants: constants of the main graph, by name.
        unsupported: noun phrases for content that `train` never writes, such as graphs inside of nodes.
        checksum: SHA-256 of the graph, hexadecimal.
        has_graph: whether the file has a graph.
    """

    inputs: dict[str, tuple] = field(default_factory=dict)
    outputs: dict[str, tuple] = field(default_factory=dict)
    metadata: dict[str, str] = field(default_factory=dict)
    custom_operators: set[str] = field(default_factory=set)
    external_files: set[str] = field(default_factory=set)
    nodes: list[OnnxNode] = field(default_factory=list)
    constants: dict[str, OnnxConstant] = field(default_factory=dict)
    unsupported: list[str] = field(default_factory=list)
    checksum: str = ""
    has_graph: bool = False


def read_onnx(data: bytes) -> OnnxContents:
    """Read the content of an ONNX file from its bytes, without running it.

    Raises:
        ValueError: the bytes are no ONNX file.
    """
    contents, digest = OnnxContents(), hashlib.sha256()
    try:
        for field_number, value in iterate_fields(memoryview(data)):
            if field_number == 7:
                contents.has_graph = True
                digest.update(value)
                _read_graph(value, contents, is_main_graph=True)
            elif field_number == 8:
                opset_fields = dict(iterate_fields(value))
                if (
                    decode_text(opset_fields.get(1, b"")) in STANDARD_DOMAINS
                    and opset_fields.get(2) not in SUPPORTED_OPSETS
                ):
                    contents.unsupported.append(f"operators of version {opset_fields.get(2)!r}")
            elif field_number == 20:
                contents.unsupported.append("a training of its own")
            elif field_number == 14:
                property_fields = dict(iterate_fields(value))
                contents.metadata[decode_text(property_fields.get(1, b""))] = decode_text(property_fields.get(2, b""))
            elif field_number == 25:
                contents.custom_operators.add("a function of the file's own")
    except (IndexError, TypeError, UnicodeDecodeError) as error:
        raise ValueError("not an ONNX file") from error
    if not contents.has_graph:
        raise ValueError("not an ONNX file")
    contents.checksum = digest.hexdigest()
    return contents


def _read_graph(data: memoryview, contents: OnnxContents, is_main_graph: bool = False, depth: int = 0) -> None:
    if depth > MAX_DEPTH:
        raise ValueError("its graphs are nested too deeply")
    for field_number, value in iterate_fields(data):
        if field_number == 1:
            _read_node(value, contents, depth)
        elif field_number == 5:
            name, constant = _read_tensor(value, contents)
            if name in contents.constants:
                contents.unsupported.append(f"two constants '{name}'")
            elif is_main_graph:
                contents.constants[name] = constant
        elif field_number == 15:
            contents.unsupported.append("sparse tensors")
            _read_sparse_tensor(value, contents)
        elif is_main_graph and field_number in (11, 12):
            name, shape = _read_input_or_output(value)
            (contents.inputs if field_number == 11 else contents.outputs)[name] = shape


def _read_node(data: memoryview, contents: OnnxContents, depth: int) -> None:
    operator = domain = ""
    inputs, outputs, attributes = [], [], {}
    for field_number, value in iterate_fields(data):
        if field_number in (1, 2):
            (inputs if field_number == 1 else outputs).append(decode_text(value))
        elif field_number == 4:
            operator = decode_text(value)
        elif field_number == 7:
            domain = decode_text(value)
        elif field_number == 5:
            name, attribute = _read_attribute(value, contents, depth)
            attributes[name] = attribute
    if domain not in STANDARD_DOMAINS:
        contents.custom_operators.add(f"{domain}::{operator}")
    if depth == 0:
        contents.nodes.append(OnnxNode(operator, tuple(inputs), tuple(outputs), attributes))


def _read_attribute(data: memoryview, contents: OnnxContents, depth: int) -> tuple[str, int | tuple[int, ...] | None]:
    name, integer, integers, has_other_field = "", None, [], False
    for field_number, value in iterate_fields(data):
        if field_number == 1:
            name = decode_text(value)
        elif field_number == 3:
            integer = to_signed(value)
        elif field_number == 8:
            integers += read_integers(value)
        elif field_number in (5, 10):
            contents.unsupported.append("tensors inside of nodes")
            _read_tensor(value, contents)
        elif field_number in (6, 11):
            contents.unsupported.append("graphs inside of nodes")
            _read_graph(value, contents, depth=depth + 1)
        elif field_number in (22, 23):
            contents.unsupported.append("sparse tensors")
            _read_sparse_tensor(value, contents)
        elif field_number not in (2, 13, 20, 21):
            has_other_field = True
    if len(integers) > MAX_ATTRIBUTE_LENGTH:
        contents.unsupported.append("a node with a long list")
    return name, None if has_other_field else tuple(integers) or integer


def _read_tensor(data: memoryview, contents: OnnxContents) -> tuple[str, OnnxConstant]:
    is_external, location = False, ""
    name, element_type, shape, raw_fields, is_unsupported = "", 0, [], [], False
    for field_number, value in iterate_fields(data):
        if field_number == 1:
            shape += read_integers(value)
        elif field_number == 2:
            element_type = value
        elif field_number == 8:
            name = decode_text(value)
        elif field_number == 9:
            raw_fields.append(value)
        elif field_number in (3, 4, 5, 6, 7, 10, 11):
            # Segments and typed fields of elements, which `train` does not write.
            is_unsupported = True
        if field_number == 13:
            is_external = True
            entry_fields = dict(iterate_fields(value))
            if decode_text(entry_fields.get(1, b"")) == "location":
                location = decode_text(entry_fields.get(2, b""))
        elif field_number == 14 and value != 0:
            is_external = True
    if is_external:
        contents.external_files.add(location)
    raw_bytes = raw_fields[0] if len(raw_fields) == 1 and not isinstance(raw_fields[0], int) else memoryview(b"")
    is_valid_shape = len(shape) <= MAX_DIMENSIONS and min(shape, default=0) >= 0
    if (
        is_unsupported
        or len(raw_fields) > 1
        or not is_valid_shape
        or math.prod(shape) * ITEM_BYTES.get(element_type, 0) != len(raw_bytes)
    ):
        contents.unsupported.append(f"a constant '{name}' that is not of the size that it says")
    elif element_type not in ITEM_BYTES:
        contents.unsupported.append(f"a constant '{name}' of another type than numbers")
    return name, OnnxConstant(element_type, tuple(shape), raw_bytes)


def _read_sparse_tensor(data: memoryview, contents: OnnxContents) -> None:
    for field_number, value in iterate_fields(data):
        if field_number in (1, 2):
            _read_tensor(value, contents)


def _read_input_or_output(data: memoryview) -> tuple[str, tuple]:
    name, shape = "", []
    for field_number, value in iterate_fields(data):
        if field_number == 1:
            name = decode_text(value)
        elif field_number == 2:
            tensor_type = dict(iterate_fields(value)).get(1, b"")
            for dimension in (
                inner_value
                for inner_number, inner_value in iterate_fields(dict(iterate_fields(tensor_type)).get(2, b""))
                if inner_number == 1
            ):
                dimension_fields = dict(iterate_fields(dimension))
                shape.append(
                    dimension_fields[1] if 1 in dimension_fields else decode_text(dimension_fields.get(2, b"?"))
                )
    return name, tuple(shape)
