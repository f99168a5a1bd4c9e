# SPDX-License-Identifier: GPL-3.0-or-later
"""Reading of the content of an untrusted ONNX file without running it.

ONNX Runtime opens external data files and loads custom operators while it reads a model, and Blender has no `onnx`
package. So the few relevant protobuf fields are read here
(https://onnx.ai/onnx/repo-docs/IR.html, onnx.proto; wire format: https://protobuf.dev/programming-guides/encoding/).
"""

import hashlib
import math
from collections.abc import Iterator
from dataclasses import dataclass, field

ITEM_BYTES = {1: 4, 2: 1, 3: 1, 6: 4, 7: 8, 10: 2}
"""Bytes per element by ONNX data type: float, uint8, int8, int32, int64, float16."""
INT64 = 7
MAX_DIMENSIONS = 8
MAX_CONSTANT_INTEGERS = 1 << 16
"""Largest number of elements of a constant that is read; the longest has the sizes of all partitions."""
MAX_ATTRIBUTE_LENGTH = 16
STANDARD_DOMAINS = ("", "ai.onnx")
SUPPORTED_OPSETS = range(13, 24)
"""Versions in which the operators of models are the same."""
MAX_DEPTH = 8
"""Deepest nesting of subgraphs that is read."""


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
        size = ITEM_BYTES[INT64]
        return tuple(
            int.from_bytes(self.data[start : start + size], "little", signed=True)
            for start in range(0, len(self.data), size)
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
        inputs, outputs: name to shape; a dimension is an int, or a str where it is dynamic.
        metadata: the metadata properties.
        custom_operators: operators outside the standard domains, "domain::name".
        external_files: files of external tensors; "" where the file is not named.
        nodes, constants: of the main graph, in their order and by name.
        unsupported: clauses about what `train` never writes: graphs inside of nodes, tensors in other forms.
        checksum: SHA-256 of the graph, hexadecimal.
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
        for number, value in _fields(memoryview(data)):
            if number == 7:
                contents.has_graph = True
                digest.update(value)
                _read_graph(value, contents, top=True)
            elif number == 8:
                opset = dict(_fields(value))
                if _text(opset.get(1, b"")) in STANDARD_DOMAINS and opset.get(2) not in SUPPORTED_OPSETS:
                    contents.unsupported.append(f"operators of version {opset.get(2)!r}")
            elif number == 20:
                contents.unsupported.append("a training of its own")
            elif number == 14:
                prop = dict(_fields(value))
                contents.metadata[_text(prop.get(1, b""))] = _text(prop.get(2, b""))
            elif number == 25:
                contents.custom_operators.add("a function of the file's own")
    except (IndexError, TypeError, UnicodeDecodeError) as error:
        raise ValueError("not an ONNX file") from error
    if not contents.has_graph:
        raise ValueError("not an ONNX file")
    contents.checksum = digest.hexdigest()
    return contents


def _fields(data: memoryview) -> Iterator[tuple[int, memoryview | int]]:
    """Yield field numbers and raw values of a protobuf message."""
    position, end = 0, len(data)
    while position < end:
        key, position = _varint(data, position)
        wire_type = key & 7
        if wire_type == 0:
            value, position = _varint(data, position)
        elif wire_type in (1, 5):
            size = 8 if wire_type == 1 else 4
            value, position = data[position : position + size], position + size
        elif wire_type == 2:
            size, position = _varint(data, position)
            value, position = data[position : position + size], position + size
        else:
            raise ValueError("not an ONNX file")
        # Other readers cut a longer key to 32 bits, which would hide a field from this reader.
        if position > end or key >> 32:
            raise ValueError("not an ONNX file")
        yield key >> 3, value


def _varint(data: memoryview, position: int) -> tuple[int, int]:
    value = shift = 0
    while shift < 70:
        byte = data[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position
        shift += 7
    raise ValueError("not an ONNX file")


def _text(data: memoryview | bytes) -> str:
    if isinstance(data, int):
        raise TypeError("a number where text belongs")
    return bytes(data).decode("utf-8")


def _read_graph(data: memoryview, contents: OnnxContents, top: bool = False, depth: int = 0) -> None:
    if depth > MAX_DEPTH:
        raise ValueError("its graphs are nested too deeply")
    for number, value in _fields(data):
        if number == 1:
            _read_node(value, contents, depth)
        elif number == 5:
            name, constant = _read_tensor(value, contents)
            if name in contents.constants:
                contents.unsupported.append(f"two constants '{name}'")
            elif top:
                contents.constants[name] = constant
        elif number == 15:
            contents.unsupported.append("sparse tensors")
            _read_sparse_tensor(value, contents)
        elif top and number in (11, 12):
            name, shape = _read_value_info(value)
            (contents.inputs if number == 11 else contents.outputs)[name] = shape


def _read_node(data: memoryview, contents: OnnxContents, depth: int) -> None:
    operator = domain = ""
    inputs, outputs, attributes = [], [], {}
    for number, value in _fields(data):
        if number in (1, 2):
            (inputs if number == 1 else outputs).append(_text(value))
        elif number == 4:
            operator = _text(value)
        elif number == 7:
            domain = _text(value)
        elif number == 5:
            name, attribute = _read_attribute(value, contents, depth)
            attributes[name] = attribute
    if domain not in STANDARD_DOMAINS:
        contents.custom_operators.add(f"{domain}::{operator}")
    if depth == 0:
        contents.nodes.append(OnnxNode(operator, tuple(inputs), tuple(outputs), attributes))


def _read_attribute(data: memoryview, contents: OnnxContents, depth: int) -> tuple[str, int | tuple[int, ...] | None]:
    name, single, several, is_other = "", None, [], False
    for number, value in _fields(data):
        if number == 1:
            name = _text(value)
        elif number == 3:
            single = _to_signed(value)
        elif number == 8:
            several += _read_integers(value)
        elif number in (5, 10):
            contents.unsupported.append("tensors inside of nodes")
            _read_tensor(value, contents)
        elif number in (6, 11):
            contents.unsupported.append("graphs inside of nodes")
            _read_graph(value, contents, depth=depth + 1)
        elif number in (22, 23):
            contents.unsupported.append("sparse tensors")
            _read_sparse_tensor(value, contents)
        elif number not in (2, 13, 20, 21):
            is_other = True
    if len(several) > MAX_ATTRIBUTE_LENGTH:
        contents.unsupported.append("a node with a long list")
    return name, None if is_other else tuple(several) or single


def _to_signed(value: int) -> int:
    """Convert a 64-bit varint to a signed integer."""
    if not isinstance(value, int):
        raise TypeError("text where a number belongs")
    return value - (1 << 64) if value >> 63 else value


def _read_integers(value: int | memoryview) -> list[int]:
    """Read one integer, or a packed list of integers."""
    if isinstance(value, int):
        return [_to_signed(value)]
    found, position = [], 0
    while position < len(value):
        number, position = _varint(value, position)
        found.append(_to_signed(number))
    return found


def _read_tensor(data: memoryview, contents: OnnxContents) -> tuple[str, OnnxConstant]:
    is_external, location = False, ""
    name, element_type, shape, content, is_unsupported = "", 0, [], [], False
    for number, value in _fields(data):
        if number == 1:
            shape += _read_integers(value)
        elif number == 2:
            element_type = value
        elif number == 8:
            name = _text(value)
        elif number == 9:
            content.append(value)
        elif number in (3, 4, 5, 6, 7, 10, 11):
            # Segments and typed element fields, which train does not write.
            is_unsupported = True
        if number == 13:
            is_external = True
            entry = dict(_fields(value))
            if _text(entry.get(1, b"")) == "location":
                location = _text(entry.get(2, b""))
        elif number == 14 and value != 0:
            is_external = True
    if is_external:
        contents.external_files.add(location)
    raw = content[0] if len(content) == 1 and not isinstance(content[0], int) else memoryview(b"")
    is_shape = len(shape) <= MAX_DIMENSIONS and min(shape, default=0) >= 0
    if (
        is_unsupported
        or len(content) > 1
        or not is_shape
        or math.prod(shape) * ITEM_BYTES.get(element_type, 0) != len(raw)
    ):
        contents.unsupported.append(f"a constant '{name}' that is not of the size that it says")
    elif element_type not in ITEM_BYTES:
        contents.unsupported.append(f"a constant '{name}' of another type than numbers")
    return name, OnnxConstant(element_type, tuple(shape), raw)


def _read_sparse_tensor(data: memoryview, contents: OnnxContents) -> None:
    for number, value in _fields(data):
        if number in (1, 2):
            _read_tensor(value, contents)


def _read_value_info(data: memoryview) -> tuple[str, tuple]:
    name, shape = "", []
    for number, value in _fields(data):
        if number == 1:
            name = _text(value)
        elif number == 2:
            tensor_type = dict(_fields(value)).get(1, b"")
            for dimension in (d for n, d in _fields(dict(_fields(tensor_type)).get(2, b"")) if n == 1):
                values = dict(_fields(dimension))
                shape.append(values[1] if 1 in values else _text(values.get(2, b"?")))
    return name, tuple(shape)
