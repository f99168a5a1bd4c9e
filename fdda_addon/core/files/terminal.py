# SPDX-License-Identifier: GPL-3.0-or-later
"""Output to a terminal whose encoding lacks characters of a name: they are escaped, so that printing never fails."""

import os
import sys


def escape_unencodable_output() -> None:
    """Make stdout and stderr escape characters that their encoding lacks: "Ärmel" becomes `\\xc4rmel` in ASCII."""
    for stream in (sys.stdout, sys.stderr):
        # A caller may have replaced the stream by an object without this method.
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def restart_in_utf8_mode() -> None:
    """Restart this Python program in UTF-8 mode where it decodes names and paths as ASCII.

    Names of objects are UTF-8. With LC_ALL=C Python chooses UTF-8 mode itself, unless PYTHONUTF8=0 is set. Blender
    always uses UTF-8.
    """
    if sys.getfilesystemencoding() == "ascii":
        os.execv(sys.executable, [sys.executable, "-X", "utf8", *sys.orig_argv[1:]])
