# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether what a target showed can be learnt: poses that did not settle, frames that jump or stand still, its place."""

from .warning import listed


def unsettled_in_words(index: dict) -> str:
    """A sentence about the poses of a recording that did not come to rest; empty where all did.

    Args:
        index: as `read_index` gives it.
    """
    unsettled = index.get("unsettled", [])
    if not unsettled:
        return ""
    return (
        f"{len(unsettled)} of {index['complete']} poses did not come to rest in {index['target']['settle']} frames: "
        f"{listed(unsettled)}. A training leaves them out; more frames (--settle) let them rest."
    )
