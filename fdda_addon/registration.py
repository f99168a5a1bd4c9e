# SPDX-License-Identifier: GPL-3.0-or-later
"""Registers and unregisters the classes, properties and handlers of the add-on.

A package of Blender classes lists its modules in `MODULES`, and each module lists its classes in `CLASSES`. A module
with handlers lists them in `HANDLERS`; `handler_table` returns all of them.
"""

import atexit
from collections.abc import Callable
from importlib import import_module
from types import ModuleType

import bpy

_is_registered = False


def register() -> None:
    """Register the add-on; do nothing if it is registered."""
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
        # Blender disables its add-ons before it quits, but the `bpy` module does not.
        atexit.register(unregister)


def is_registered() -> bool:
    """Return whether the add-on is registered."""
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
    # Handlers that stay registered hang the `bpy` module of 4.5 at its exit.
    for name, handler in handler_table():
        listed = getattr(bpy.app.handlers, name)
        if handler in listed:
            listed.remove(handler)
    handlers.unregister()
    for package in (panels, operators, properties):
        _unregister_package(package)


def handler_table() -> list[tuple[str, Callable[..., None]]]:
    """Return the handlers of the add-on: name of the list in `bpy.app.handlers` and function, in calling order."""
    from .evaluation import side_by_side
    from .jobs import job
    from .operators import training
    from .panels import checks
    from .runtime import handlers
    from .scene import stored_paths

    # After a save, paths are restored before models are loaded.
    modules = (stored_paths, job, checks, handlers, side_by_side, training)
    return [entry for module in modules for entry in module.HANDLERS.items()]


def _register_package(package: ModuleType) -> None:
    """Register the classes of all modules in their order, and call the `register` of each module after its classes."""
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
