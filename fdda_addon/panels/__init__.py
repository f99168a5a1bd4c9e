# SPDX-License-Identifier: GPL-3.0-or-later
"""The sidebar panel "FDDA" of the 3D View: a section a module, in the order of the work."""

from importlib import import_module
from types import ModuleType

MODULES: tuple[str, ...] = ("rig", "poses", "recording", "training", "playback", "evaluation", "models")
"""The modules of this package in the order of their sections; each lists its classes in `CLASSES`."""


def register() -> None:
    """Register the classes of all modules, then what a module registers itself."""
    import bpy

    for module in _modules():
        for cls in module.CLASSES:
            bpy.utils.register_class(cls)
        if hasattr(module, "register"):
            module.register()


def unregister() -> None:
    """Undo `register`."""
    import bpy

    for module in reversed(_modules()):
        if hasattr(module, "unregister"):
            module.unregister()
        for cls in reversed(module.CLASSES):
            bpy.utils.unregister_class(cls)


def _modules() -> list[ModuleType]:
    return [import_module(f".{name}", __name__) for name in MODULES]
