# SPDX-License-Identifier: GPL-3.0-or-later
"""Gives panels access to the module `heat_map` without importing it, because it imports numpy."""

import sys
from types import ModuleType


def loaded_heat_map() -> ModuleType | None:
    """Return the module `heat_map`; None if nothing has imported it in this session."""
    return sys.modules.get(f"{__package__}.heat_map")
