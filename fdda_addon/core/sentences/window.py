# SPDX-License-Identifier: GPL-3.0-or-later
"""Names in sentences the fields of the window in place of options of the command line."""

import re

from .. import settings

LABELS = {
    "--extra-input": "Extra Inputs",
    **{s.option: s.label for s in vars(settings).values() if isinstance(s, settings.Setting) and s.label},
}
"""Labels of fields by options that are not spelled as their field; those of settings are in their declarations."""
PHRASES = (
    ("--base-skinning smooth, or Base Skinning", "Base Skinning"),
    ("--base-skinning smooth", "Base Skinning"),
    ("--controls collection:NAME", "Bone Collection"),
    ("for --controls", "for"),
    ("give --poses or --action", "set Random Poses, or check an action"),
    ("give --action or --strip", "check an action or a strip"),
    ("0 random poses (--action NAME --poses 0)", "Random Poses at 0"),
    ("run the command again, `record` with --resume", "press Resume"),
    ("(--action NAME)", "in Training Poses"),
)
"""Phrases with options, and the words of the window where these differ."""
SMALL_WORDS = {"To", "Per", "Of"}


def for_window(text: str) -> str:
    """Return a text with fields of the window in place of options: "--bones-to-pose" is "Bones to Pose"."""
    if "--" not in text:
        return text
    for phrase, label in PHRASES:
        text = text.replace(phrase, label)

    def label(match: re.Match[str]) -> str:
        words = match[0].replace("-", " ").title().split()
        return LABELS.get(match[0], " ".join(word.lower() if word in SMALL_WORDS else word for word in words))

    return re.sub(r"(?<![\w-])--[a-z][a-z-]*", label, text)
