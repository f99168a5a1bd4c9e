# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks of JSON from files against a description of its keys and the types of their values."""

import reprlib
from typing import NamedTuple

MAX_NUMBER = 1e300
"""Largest absolute value of a number."""
MAX_TEXT_LENGTH = 10_000
"""Largest number of characters of a text. Names in Blender have at most 255, sentences at most 1,000."""
COUNT, WHOLE = range(1 << 62), range(-(1 << 62), 1 << 62)
"""Descriptions of a whole number from 0, and of any."""


class Interval(NamedTuple):
    """Description of a number that is not below `low` and not above `high`."""

    low: float
    high: float = MAX_NUMBER


NOT_NEGATIVE, POSITIVE, NUMBER = Interval(0), Interval(1e-300), Interval(-MAX_NUMBER)


def check_json(value: object, description: object, key_path: str = "it") -> None:
    """Check a value of a JSON file.

    Args:
        description: one of:
            - a dictionary of keys and descriptions: an object; `?` marks an optional key, and further keys are
              permitted. The key `str` describes the values of all keys.
            - a list of one description: a list
            - a tuple of a description and None: that, or null
            - a set: one of these texts
            - a range: a whole number in it
            - an `Interval`: a number in it
            - a type: `str`, `bool`, or `list` for any list
        key_path: path of the value in the file, for the error.

    Raises:
        ValueError: the value is not as described; the message is a clause with the path of the key.
    """
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if isinstance(description, Interval):
        is_valid = is_number and description.low <= value <= description.high
    elif isinstance(description, range):
        is_valid = is_number and isinstance(value, int) and value in description
    elif isinstance(description, set):
        is_valid = isinstance(value, str) and value in description
    elif isinstance(description, tuple):
        return None if value is None else check_json(value, description[0], key_path)
    elif isinstance(description, dict):
        is_valid = isinstance(value, dict) and all(len(key) <= MAX_TEXT_LENGTH for key in value)
        for key, inner in description.items() if is_valid else ():
            names = list(value) if key is str else [key.removesuffix("?")]
            for name in names:
                if name in value:
                    check_json(value[name], inner, f"{key_path}.{name}".removeprefix("it."))
                elif name == key:
                    raise ValueError(f"{key_path} lacks '{name}'")
    elif isinstance(description, list):
        is_valid = isinstance(value, list)
        for index, entry in enumerate(value if is_valid else ()):
            check_json(entry, description[0], f"{key_path}[{index}]")
    else:
        is_valid = isinstance(value, description) and (description is not str or len(value) <= MAX_TEXT_LENGTH)
    if not is_valid:
        raise ValueError(f"{key_path} is {reprlib.repr(value)}")
    return None
