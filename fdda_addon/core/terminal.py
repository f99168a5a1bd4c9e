# SPDX-License-Identifier: GPL-3.0-or-later
"""What a terminal or a log cannot show is written out in its place, so that no name ends a verb."""

import os
import sys


def escape_unencodable_output() -> None:
    """Let stdout and stderr escape what their encoding lacks: `\\xc4rmel` where there is nothing but ASCII."""
    for stream in (sys.stdout, sys.stderr):
        # Whoever calls a verb may have put something else in their place.
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def restart_in_utf8_mode() -> None:
    """Start this program of Python again where it takes names and paths for ASCII: those of objects are UTF-8.

    With LC_ALL=C Python does so by itself, unless it was told not to (PYTHONUTF8=0). Blender always does.
    """
    if sys.getfilesystemencoding() == "ascii":
        os.execv(sys.executable, [sys.executable, "-X", "utf8", *sys.orig_argv[1:]])
