# SPDX-License-Identifier: GPL-3.0-or-later
"""Formats numbers of things."""


def format_count(count: int, noun: str, plural: str = "") -> str:
    """Format a number with its noun: "1 bone", "1,000 bones"; `plural` is for nouns without a plural in -s."""
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {plural or noun + 's'}"
