# SPDX-License-Identifier: GPL-3.0-or-later
"""Output to a terminal whose encoding lacks characters of a name: they are escaped, so that printing never fails."""

import sys


def escape_unencodable_output() -> None:
    """Make stdout and stderr escape characters that their encoding lacks: "Ärmel" becomes `\\xc4rmel` in ASCII."""
    for stream in (sys.stdout, sys.stderr):
        # A caller may have replaced the stream by an object without this method.
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
