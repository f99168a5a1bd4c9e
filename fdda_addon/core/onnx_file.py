# SPDX-License-Identifier: GPL-3.0-or-later
"""Looks into an ONNX file before anything executes it.

A model may come from anyone. ONNX Runtime would open external data files and load custom operators while it reads a
model, and the `onnx` package is not at hand inside Blender, so the few protobuf fields that matter are read here
(https://onnx.ai/onnx/repo-docs/IR.html, onnx.proto; wire format: https://protobuf.dev/programming-guides/encoding/).
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

STANDARD_DOMAINS = ("", "ai.onnx")
MAX_DEPTH = 8
"""Deepest nesting of subgraphs that is followed."""


@dataclass
class OnnxContents:
    """What an ONNX file declares.

    Attributes:
        inputs, outputs: name to shape; a dimension is an int, or a str where it is dynamic.
        metadata: the metadata properties.
        custom_operators: operators outside the standard domains, "domain::name".
        external_files: files that tensors refer to; "" for one that says its data lies outside and not where.
    """

    inputs: dict[str, tuple] = field(default_factory=dict)
    outputs: dict[str, tuple] = field(default_factory=dict)
    metadata: dict[str, str] = field(default_factory=dict)
    custom_operators: set[str] = field(default_factory=set)
    external_files: set[str] = field(default_factory=set)
    has_graph: bool = False


def read_onnx(data: bytes) -> OnnxContents:
    """Read what the bytes of a file declare, without executing it.

    Raises:
        ValueError: they are not those of an ONNX file.
    """
    contents = OnnxContents()
    try:
        for number, value in _fields(memoryview(data)):
            if number == 7:
                contents.has_graph = True
                _read_graph(value, contents, top=True)
            elif number == 14:
                prop = dict(_fields(value))
                contents.metadata[_text(prop.get(1, b""))] = _text(prop.get(2, b""))
            elif number == 25:
                contents.custom_operators.add("a function of the file's own")
    except (IndexError, TypeError, UnicodeDecodeError) as error:
        raise ValueError("not an ONNX file") from error
    if not contents.has_graph:
        raise ValueError("not an ONNX file")
    return contents


def _fields(data: memoryview) -> Iterator[tuple[int, memoryview | int]]:
    """Field numbers and raw values of one protobuf message."""
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
        # Readers cut a longer key to 32 bits, which would hide a field from this one.
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
            _read_tensor(value, contents)
        elif number == 15:
            _read_sparse_tensor(value, contents)
        elif top and number in (11, 12):
            name, shape = _read_value_info(value)
            (contents.inputs if number == 11 else contents.outputs)[name] = shape


def _read_node(data: memoryview, contents: OnnxContents, depth: int) -> None:
    operator = domain = ""
    for number, value in _fields(data):
        if number == 4:
            operator = _text(value)
        elif number == 7:
            domain = _text(value)
        elif number == 5:
            for attribute, content in _fields(value):
                if attribute in (5, 10):
                    _read_tensor(content, contents)
                elif attribute in (6, 11):
                    _read_graph(content, contents, depth=depth + 1)
                elif attribute in (22, 23):
                    _read_sparse_tensor(content, contents)
    if domain not in STANDARD_DOMAINS:
        contents.custom_operators.add(f"{domain}::{operator}")


def _read_tensor(data: memoryview, contents: OnnxContents) -> None:
    is_external, location = False, ""
    for number, value in _fields(data):
        if number == 13:
            is_external = True
            entry = dict(_fields(value))
            if _text(entry.get(1, b"")) == "location":
                location = _text(entry.get(2, b""))
        elif number == 14 and value != 0:
            is_external = True
    if is_external:
        contents.external_files.add(location)


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
