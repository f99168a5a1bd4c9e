# SPDX-License-Identifier: GPL-3.0-or-later
"""Formats numbers of things."""


def format_count(count: int, noun: str) -> str:
    """Format a number with its noun: "1 bone", "1,000 bones"."""
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"
