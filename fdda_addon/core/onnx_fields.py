# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads the fields of the protobuf messages in an ONNX file."""

from collections.abc import Iterator


def iterate_fields(data: memoryview) -> Iterator[tuple[int, memoryview | int]]:
    """Yield the number and the raw value of each field of a protobuf message."""
    position, end = 0, len(data)
    while position < end:
        field_key, position = _read_varint(data, position)
        wire_type = field_key & 7
        if wire_type == 0:
            value, position = _read_varint(data, position)
        elif wire_type in (1, 5):
            size = 8 if wire_type == 1 else 4
            value, position = data[position : position + size], position + size
        elif wire_type == 2:
            size, position = _read_varint(data, position)
            value, position = data[position : position + size], position + size
        else:
            raise ValueError("not an ONNX file")
        # Other readers truncate a longer key to 32 bits. They would find a field that this reader does not.
        if position > end or field_key >> 32:
            raise ValueError("not an ONNX file")
        yield field_key >> 3, value


def _read_varint(data: memoryview, position: int) -> tuple[int, int]:
    value = shift = 0
    while shift < 70:
        byte = data[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position
        shift += 7
    raise ValueError("not an ONNX file")


def decode_text(data: memoryview | bytes) -> str:
    if isinstance(data, int):
        raise TypeError("a number where text belongs")
    return bytes(data).decode("utf-8")


def to_signed(value: int) -> int:
    """Convert a 64-bit varint to a signed integer."""
    if not isinstance(value, int):
        raise TypeError("text where a number belongs")
    return value - (1 << 64) if value >> 63 else value


def read_integers(value: int | memoryview) -> list[int]:
    """Read one integer, or a packed list of integers."""
    if isinstance(value, int):
        return [to_signed(value)]
    integers, position = [], 0
    while position < len(value):
        varint, position = _read_varint(value, position)
        integers.append(to_signed(varint))
    return integers
