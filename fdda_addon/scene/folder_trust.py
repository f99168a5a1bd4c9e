# SPDX-License-Identifier: GPL-3.0-or-later
"""From which folders a .blend file may name a model, besides its own: those that the user trusts in the preferences.

A file of somebody else can so have no other file read than a model, and that from places that the user has named.
"""

from collections.abc import Callable
from pathlib import Path

trusted_folders: Callable[[], list[Path]] = list
"""The trusted folders, absolute and without links; the preferences set it."""


def is_trusted(path: Path) -> bool:
    """Whether a path lies in a trusted folder or below; links are followed first."""
    resolved = path.resolve()
    return any(resolved.is_relative_to(folder) for folder in trusted_folders())
