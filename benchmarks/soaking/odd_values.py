# SPDX-License-Identifier: GPL-3.0-or-later
"""Random mutations of bytes and of JSON values."""

import copy
import json

import numpy as np

ODD_VALUES = (
    None, True, False, 0, 1, -1, 2**31, 2**63, -(2**63), 10**30, 1e308, -1e-308, float("inf"), float("-inf"),
    float("nan"), "", "x", "7", "ß\x1b[2J\n", "../../etc/passwd", "/dev/zero", "x" * 100_000, [], [[]], [0] * 1000,
    {}, {"a": {"b": []}}, [None], [{}], "\ud800",
)  # fmt: skip


def mutate_bytes(random: np.random.Generator, data: bytes) -> bytes:
    """Return a copy of bytes with some flipped, removed, repeated or replaced."""
    data = bytearray(data)
    for _ in range(int(random.integers(1, 4))):
        start = int(random.integers(max(1, len(data))))
        length = int(2 ** random.uniform(0, np.log2(len(data) + 2)))
        kind = random.integers(7)
        if kind < 3:
            for _ in range(int(random.integers(1, 33))):
                # The structure of a file is mostly at its beginning.
                index = (
                    int(random.integers(len(data)))
                    if random.random() < 0.4
                    else int(random.integers(min(4096, len(data))))
                )
                data[index] ^= 1 << int(random.integers(8))
        elif kind == 3:
            del data[start:]
        elif kind == 4:
            del data[start : start + length]
        elif kind == 5:
            data[start:start] = data[start : start + length]
        else:
            data[start : start + length] = random.bytes(min(length, 4096))
        if not data:
            return b""
    return bytes(data)


def mutate_json(random: np.random.Generator, value: object) -> object:
    """Return a copy of a JSON value with some values replaced, removed or added."""
    value = copy.deepcopy(value)
    for _ in range(int(random.integers(1, 4))):
        holder, key = _random_entry(random, value)
        if holder is None:
            return ODD_VALUES[random.integers(len(ODD_VALUES))]
        kind = random.integers(6)
        if kind == 0:
            del holder[key]
        elif kind == 1 and isinstance(holder, list):
            holder.insert(int(random.integers(len(holder) + 1)), copy.deepcopy(holder[key]))
        elif kind == 2 and isinstance(holder[key], (int, float)) and not isinstance(holder[key], bool):
            holder[key] = holder[key] * int(random.choice([-1, 2, 1000])) + int(random.integers(-2, 3))
        elif kind == 3 and isinstance(holder[key], str):
            holder[key] = mutate_bytes(random, holder[key].encode() or b"x").decode("utf-8", "replace")
        else:
            holder[key] = ODD_VALUES[random.integers(len(ODD_VALUES))]
        if not isinstance(value, (dict, list)) or not value:
            break
    return value


def to_json_text(value: object) -> str:
    """Convert a value to JSON text. NaN and infinity become names that Python reads and JSON does not allow."""
    return json.dumps(value)


def _random_entry(random: np.random.Generator, value: object) -> tuple:
    """Choose a list or object at a random depth of a value, and one of its keys."""
    holder = key = None
    while isinstance(value, (dict, list)) and value:
        holder = value
        key = int(random.integers(len(value))) if isinstance(value, list) else list(value)[random.integers(len(value))]
        value = holder[key]
        if random.random() < 0.35:
            break
    return holder, key
