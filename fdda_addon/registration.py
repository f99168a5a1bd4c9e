# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes Blender know the classes, properties and handlers of the add-on, and forget them.

A package of Blender classes lists its modules in `MODULES`, and they their classes in `CLASSES`. A module with handlers
lists them in `HANDLERS`; all are in the one table of `handler_table`.
"""

import atexit
from collections.abc import Callable
from importlib import import_module
from types import ModuleType

import bpy

_is_registered = False


def register() -> None:
    """Register all of the add-on; a second call does nothing."""
    global _is_registered
    if _is_registered:
        return
    from . import operators, panels, properties
    from .runtime import handlers

    for package in (properties, operators, panels):
        _register_package(package)
    for name, handler in handler_table():
        listed = getattr(bpy.app.handlers, name)
        if handler not in listed:
            listed.append(handler)
    handlers.register()
    _is_registered = True
    if not bpy.app.binary_path:
        # Blender itself disables its add-ons before it ends; here, at its exit, nothing of it is left.
        atexit.register(unregister)


def is_registered() -> bool:
    """Whether Blender knows the add-on."""
    return _is_registered


def unregister() -> None:
    """Undo `register`."""
    global _is_registered
    if not _is_registered:
        return
    from . import operators, panels, properties
    from .runtime import handlers

    atexit.unregister(unregister)
    _is_registered = False
    # Left registered they hang the 4.5 module at its exit.
    for name, handler in handler_table():
        listed = getattr(bpy.app.handlers, name)
        if handler in listed:
            listed.remove(handler)
    handlers.unregister()
    for package in (panels, operators, properties):
        _unregister_package(package)


def handler_table() -> list[tuple[str, Callable[..., None]]]:
    """All handlers of the add-on: name of the list in `bpy.app.handlers` and function, in the order of the calls."""
    from .evaluation import side_by_side
    from .jobs import job
    from .operators import training
    from .panels import checks
    from .runtime import handlers
    from .scene import stored_paths

    # After a save paths are put back before models are looked for.
    modules = (stored_paths, job, checks, handlers, side_by_side, training)
    return [entry for module in modules for entry in module.HANDLERS.items()]


def _register_package(package: ModuleType) -> None:
    """Register the classes of all modules in their order, each followed by what the module registers itself."""
    for module in _modules(package):
        for cls in module.CLASSES:
            bpy.utils.register_class(cls)
        if hasattr(module, "register"):
            module.register()


def _unregister_package(package: ModuleType) -> None:
    """Undo `_register_package`."""
    for module in reversed(_modules(package)):
        if hasattr(module, "unregister"):
            module.unregister()
        for cls in reversed(module.CLASSES):
            bpy.utils.unregister_class(cls)


def _modules(package: ModuleType) -> list[ModuleType]:
    return [import_module(f".{name}", package.__name__) for name in package.MODULES]
