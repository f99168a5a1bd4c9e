# SPDX-License-Identifier: GPL-3.0-or-later
"""The option `joints` of recordings: which joints a model reads. Without numpy, as Blender starts without it."""

ALL, AUTO = "all", "auto"
"""Values of the option `joints` besides a number of joints."""
KEY_JOINTS_STAGE = "key joints"
"""Name of the stage of `Progress` in which key joints are chosen."""


def parse_joints(text: str) -> str:
    """Check the option `joints`, "all", "auto" or a number from 1, and return it.

    Raises:
        ValueError: the text is something else. The message is a clause about the option.
    """
    if text not in (ALL, AUTO) and not (text.isascii() and text.isdecimal() and 1 <= int(text) <= 100_000):
        raise ValueError(f"joints are {AUTO}, {ALL}, or a number from 1, and not {text!r}")
    return text if text in (ALL, AUTO) else str(int(text))
