# SPDX-License-Identifier: GPL-3.0-or-later
"""The heat map as panels ask for it: where nothing was ever painted it is not imported, nor numpy with it."""

import sys
from types import ModuleType


def loaded_heat_map() -> ModuleType | None:
    """The module `heat_map`; None while nothing was painted in this session."""
    return sys.modules.get(f"{__package__}.heat_map")
