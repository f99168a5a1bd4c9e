# SPDX-License-Identifier: GPL-3.0-or-later
"""The operators: a button each. Poll, gather, call, report; the work is done by the modules below."""

from importlib import import_module
from types import ModuleType

MODULES: tuple[str, ...] = (
    "job",
    "trainer_environment",
    "rig",
    "poses",
    "recording",
    "training",
    "playback",
    "evaluation",
    "worst_poses",
    "models",
)
"""The modules of this package; each lists its classes in `CLASSES`."""


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
