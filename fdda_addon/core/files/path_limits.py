# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks for output paths that Windows or Blender would truncate or change without an error."""

import os
import sys
from pathlib import Path

from ..errors import OutputError

MAX_WINDOWS_PATH_LENGTH = 259
MAX_BLENDER_PATH_BYTES = 1023
"""Blender silently truncates longer paths, which may name another file."""
EXTENDED_PATH_PREFIX = "\\\\?\\"
"""Prefix of paths whose length Windows does not limit."""


def check_path(path: Path, *files: Path) -> None:
    """Check that paths are short enough, and that Windows does not change their names.

    Args:
        path: file or folder that the user named.
        files: all files that are written there, including temporary files.

    Raises:
        OutputError: a path is too long, or would be changed.
    """
    if limit := path_length_problem(max((file.absolute() for file in files), key=lambda file: len(os.fsencode(file)))):
        raise OutputError(f"Cannot write '{path}': {limit}; choose a shorter folder.")
    names = (name for name in path.absolute().parts[1:] if is_windows() and name != "..")
    # Windows writes the first to a hidden stream of another file, and drops the others. What it refuses is tried.
    if changed := next((name for name in names if ":" in name or name.rstrip(". ") != name), ""):
        raise OutputError(
            f"Cannot write '{path}': '{changed}' has a colon, or a dot or a blank at its end, which Windows changes; "
            "give another name."
        )


def path_length_problem(path: Path) -> str:
    """Describe why an absolute path is too long for Blender or the operating system; empty where it is short enough."""
    text = str(path)
    if (size := len(os.fsencode(text))) > MAX_BLENDER_PATH_BYTES:
        return f"it needs a path of {size:,} bytes, and Blender takes {MAX_BLENDER_PATH_BYTES:,}"
    is_long = len(text) > MAX_WINDOWS_PATH_LENGTH and not text.startswith(EXTENDED_PATH_PREFIX)
    if is_windows() and is_long and not supports_long_windows_paths():
        return f"it needs a path of {len(text)} characters, and Windows takes {MAX_WINDOWS_PATH_LENGTH}"
    return ""


def comparable_path(path: Path) -> str:
    """Return a text that is the same for all paths of a file. It is in lower case on systems that ignore case."""
    real_path = os.path.realpath(path)
    return real_path.casefold() if sys.platform in ("win32", "darwin") else real_path


def is_windows() -> bool:
    return sys.platform == "win32"


def supports_long_windows_paths() -> bool:
    """Return whether Windows permits long paths; both the system and the program must enable them."""
    import ctypes

    try:
        return bool(ctypes.WinDLL("ntdll").RtlAreLongPathsEnabled() & 0xFF)
    except AttributeError:
        # Windows before version 1607 of Windows 10.
        return False
