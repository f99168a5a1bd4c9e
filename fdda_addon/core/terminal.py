# SPDX-License-Identifier: GPL-3.0-or-later
"""What a terminal or a log cannot show is written out in its place, so that no name ends a verb."""

import sys


def show_all_names() -> None:
    """Let stdout and stderr escape what their encoding lacks: `\\xc4rmel` where there is nothing but ASCII."""
    for stream in (sys.stdout, sys.stderr):
        # Whoever calls a verb may have put something else in their place.
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
