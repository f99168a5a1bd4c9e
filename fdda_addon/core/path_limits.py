# SPDX-License-Identifier: GPL-3.0-or-later
"""Paths that Windows or Blender would refuse, cut, or take for another file: refused before the work."""

import os
import re
import sys
from pathlib import Path, PurePath, PureWindowsPath

from .errors import OutputError

MAX_NAME_BYTES = 255
MAX_WINDOWS_PATH_LENGTH = 259
MAX_BLENDER_PATH_BYTES = 1023
"""Blender cuts longer paths without a word, and what is left names another file."""
EXTENDED_PATH_PREFIX = "\\\\?\\"
"""Begins paths whose length Windows does not limit."""
_DEVICE_NAME = re.compile(r"(con|prn|aux|nul|conin\$|conout\$|(com|lpt)[0-9¹²³]) *(\..*)?", re.IGNORECASE | re.DOTALL)
_FORBIDDEN_CHARACTER = re.compile(r'[<>:"|?*\x00-\x1f]')


def check_path(path: Path, *files: Path) -> None:
    """Fail where files could not be written because of the length of their paths, or of a name in one.

    Args:
        path: what the user named, a file or a folder.
        files: what is written there, with the names that they have meanwhile.

    Raises:
        OutputError: says why.
    """
    if limit := path_length_problem(max((file.absolute() for file in files), key=lambda file: len(os.fsencode(file)))):
        raise OutputError(f"Cannot write '{path}': {limit}; choose a shorter folder.")
    if (size := max(len(os.fsencode(name)) for name in path.absolute().parts)) > MAX_NAME_BYTES:
        raise OutputError(
            f"Cannot write '{path}': a name in it has {size} bytes, and {MAX_NAME_BYTES} are the most; shorten it."
        )
    if is_windows() and (problem := windows_name_problem(path.absolute())):
        raise OutputError(f"Cannot write '{path}': {problem}; give another name.")


def path_length_problem(path: Path) -> str:
    """Words where an absolute path is longer than Blender, or the system, takes; empty where it is not."""
    text = str(path)
    if (size := len(os.fsencode(text))) > MAX_BLENDER_PATH_BYTES:
        return f"it needs a path of {size:,} bytes, and Blender takes {MAX_BLENDER_PATH_BYTES:,}"
    is_long = len(text) > MAX_WINDOWS_PATH_LENGTH and not text.startswith(EXTENDED_PATH_PREFIX)
    if is_windows() and is_long and not supports_long_windows_paths():
        return f"it needs a path of {len(text)} characters, and Windows takes {MAX_WINDOWS_PATH_LENGTH}"
    return ""


def windows_name_problem(path: PurePath) -> str:
    """Words for the first name in an absolute path that Windows gives another meaning; empty where there is none."""
    for name in PureWindowsPath(path).parts[1:]:
        if _DEVICE_NAME.fullmatch(name):
            return f"'{name}' is the name of a device on Windows"
        if found := _FORBIDDEN_CHARACTER.search(name):
            return f"'{name}' has the character {found.group()!r}, which no name on Windows may have"
        if name.rstrip(". ") != name and name != "..":
            return f"'{name}' ends in a dot or a blank, which Windows drops"
    return ""


def comparable_path(path: Path) -> str:
    """A text that is the same for two paths of one file; where letter case makes no difference, it makes none here."""
    place = os.path.realpath(path)
    return place.casefold() if sys.platform in ("win32", "darwin") else place


def is_windows() -> bool:
    return sys.platform == "win32"


def supports_long_windows_paths() -> bool:
    """Whether Windows takes long paths from this process: the system is set so, and the program declares it."""
    import ctypes

    try:
        return bool(ctypes.WinDLL("ntdll").RtlAreLongPathsEnabled() & 0xFF)
    except AttributeError:
        # Older than Windows 10, version 1607.
        return False
