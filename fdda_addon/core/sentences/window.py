# SPDX-License-Identifier: GPL-3.0-or-later
"""Names in sentences what the window has in place of options of the command line."""

import re

PHRASES = (
    ("--fit-linear smooth, or Base Skinning in the sidebar", "Base Skinning in the sidebar"),
    ("--fit-linear smooth", "Base Skinning"),
    ("--controls collection:NAME", "Bone Collection"),
    ("for --controls", "for"),
    ("give --poses or --action", "set Random Poses, or check an action"),
    ("give --action or --strip", "check an action or a strip"),
    ("--sample", "Bones to Pose"),
    ("--control ", "Extra Inputs, "),
    ("--control", "Extra Inputs"),
    ("--min-partition-vertices", "Min Vertices per Part"),
    ("--max-settle-frames", "Settle Frames"),
)
"""Phrases with options, and the words of the window."""


def for_window(text: str) -> str:
    """Return a text with the labels of the window in place of options; others become words: "--resume" is "Resume"."""
    if "--" not in text:
        return text
    for phrase, label in PHRASES:
        text = text.replace(phrase, label)
    return re.sub(r"(?<![\w-])--([a-z][a-z-]*)", lambda match: match[1].replace("-", " ").title(), text)
