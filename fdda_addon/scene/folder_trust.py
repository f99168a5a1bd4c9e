# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks whether a path is in a folder that the user trusts in the preferences.

A .blend file may load models from these folders and from its own folder. So a file from somebody else can only make the
add-on read a model, and only from folders that the user chose.
"""

from collections.abc import Callable
from pathlib import Path

trusted_folders: Callable[[], list[Path]] = list
"""Returns the trusted folders, absolute and without links. The preferences replace this function."""


def is_trusted(path: Path) -> bool:
    """Return whether a path, with its links resolved, is in a trusted folder or below."""
    resolved = path.resolve()
    return any(resolved.is_relative_to(folder) for folder in trusted_folders())
