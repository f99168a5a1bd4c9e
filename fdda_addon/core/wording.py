# SPDX-License-Identifier: GPL-3.0-or-later
"""Numbers and names of things in sentences."""

from collections.abc import Sequence

MAX_LISTED = 3
"""Largest number of names that a message lists."""


def format_count(count: int, noun: str, plural: str = "") -> str:
    """Format a number with its noun: "1 bone", "1,000 bones"; `plural` is for nouns without a plural in -s."""
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {plural or noun + 's'}"


def format_list(names: Sequence[object], max_names: int = MAX_LISTED) -> str:
    """Format the first names or numbers of a list: "'a', 'b', 'c' and 4 more"; strings are quoted."""
    shown_names = [f"'{name}'" if isinstance(name, str) else str(name) for name in names[:max_names]]
    if len(names) > max_names:
        return f"{', '.join(shown_names)} and {len(names) - max_names} more"
    return f"{', '.join(shown_names[:-1])} and {shown_names[-1]}" if len(shown_names) > 1 else "".join(shown_names)


def format_with_noun(names: Sequence[object], noun: str, plural: str = "") -> str:
    """Format names with a noun: "the joint 'a'", "the 7 joints 'a', 'b', 'c' and 4 more"."""
    if len(names) == 1:
        return f"the {noun} {format_list(names)}"
    return f"the {len(names)} {plural or noun + 's'} {format_list(names)}"
