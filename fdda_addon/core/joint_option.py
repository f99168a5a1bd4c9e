# SPDX-License-Identifier: GPL-3.0-or-later
"""The training setting `bones_to_read`: the joints that a model reads. Without numpy: Blender starts without it."""

ALL, AUTO = "all", "auto"
"""Values of the setting besides a number of joints."""


def parse_joints(text: str) -> str:
    """Check the value of the setting, "all", "auto" or a number from 1, and return it.

    Raises:
        ValueError: the text is something else. The message is a clause about the value.
    """
    if text not in (ALL, AUTO) and not (text.isascii() and text.isdecimal() and 1 <= int(text) <= 100_000):
        raise ValueError(f"joints are {AUTO}, {ALL}, or a number from 1, and not {text!r}")
    return text if text in (ALL, AUTO) else str(int(text))
