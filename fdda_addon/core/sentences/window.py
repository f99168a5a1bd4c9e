# SPDX-License-Identifier: GPL-3.0-or-later
"""Names in sentences what the window has in place of options of the command line."""

import re

PHRASES = (
    ("--base-skinning smooth, or Base Skinning in the sidebar", "Base Skinning in the sidebar"),
    ("--base-skinning smooth", "Base Skinning"),
    ("--controls collection:NAME", "Bone Collection"),
    ("for --controls", "for"),
    ("give --poses or --action", "set Random Poses, or check an action"),
    ("give --action or --strip", "check an action or a strip"),
    ("--bones-to-pose", "Bones to Pose"),
    ("--extra-input ", "Extra Inputs, "),
    ("--extra-input", "Extra Inputs"),
    ("--min-vertices-per-part", "Min Vertices per Part"),
    ("--settle-frames", "Settle Frames"),
)
"""Phrases with options, and the words of the window."""


def for_window(text: str) -> str:
    """Return a text with the labels of the window in place of options; others become words: "--resume" is "Resume"."""
    if "--" not in text:
        return text
    for phrase, label in PHRASES:
        text = text.replace(phrase, label)
    return re.sub(r"(?<![\w-])--([a-z][a-z-]*)", lambda match: match[1].replace("-", " ").title(), text)
