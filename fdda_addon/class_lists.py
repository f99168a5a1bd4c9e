# SPDX-License-Identifier: GPL-3.0-or-later
"""Registers packages of Blender classes: each lists its modules in `MODULES`, and they their classes in `CLASSES`."""

from importlib import import_module
from types import ModuleType

import bpy


def register(package: ModuleType) -> None:
    """Register the classes of all modules in their order, each followed by what the module registers itself."""
    for module in _modules(package):
        for cls in module.CLASSES:
            bpy.utils.register_class(cls)
        if hasattr(module, "register"):
            module.register()


def unregister(package: ModuleType) -> None:
    """Undo `register`."""
    for module in reversed(_modules(package)):
        if hasattr(module, "unregister"):
            module.unregister()
        for cls in reversed(module.CLASSES):
            bpy.utils.unregister_class(cls)


def _modules(package: ModuleType) -> list[ModuleType]:
    return [import_module(f".{name}", package.__name__) for name in package.MODULES]
