# SPDX-License-Identifier: GPL-3.0-or-later
"""Gives panels access to the heat map without importing it, and numpy with it, before it is used."""

import sys
from types import ModuleType


def loaded_heat_map() -> ModuleType | None:
    """Return the module `heat_map`; None if it was not used in this session."""
    return sys.modules.get(f"{__package__}.heat_map")
