# SPDX-License-Identifier: GPL-3.0-or-later
"""Registers and unregisters the classes, properties and handlers of the add-on.

A package with Blender classes lists its modules in `MODULES`. Each module lists its classes in `CLASSES`, properties of
Blender's types in `PROPERTIES`, and functions that draw in Blender's menus in `MENUS`. A module with handlers lists
them in `HANDLERS`; `handler_table` returns the handlers of all modules.
"""

import atexit
from collections.abc import Callable
from importlib import import_module
from types import ModuleType

import bpy


def register() -> None:
    """Register the add-on; do nothing if it is registered already."""
    if is_registered():
        return
    from . import operators, panels, properties
    from .runtime import gltf_export, handlers

    for package in (properties, operators, panels):
        for module in _modules(package):
            for cls in module.CLASSES:
                bpy.utils.register_class(cls)
            for (owner, name), definition in getattr(module, "PROPERTIES", {}).items():
                setattr(owner, name, definition)
            for name, draw in getattr(module, "MENUS", {}).items():
                getattr(bpy.types, name).append(draw)
            if hasattr(module, "register"):
                module.register()
    for name, handler in handler_table():
        blender_handlers = getattr(bpy.app.handlers, name)
        if handler not in blender_handlers:
            blender_handlers.append(handler)
    handlers.register()
    if not bpy.app.binary_path:
        # Blender disables its add-ons before it quits, but the `bpy` module does not.
        atexit.register(unregister)
        # Blender has its enabled add-ons in the preferences, where the glTF exporter looks for callbacks.
        if gltf_export.__name__ not in bpy.context.preferences.addons:
            bpy.context.preferences.addons.new().module = gltf_export.__name__


def is_registered() -> bool:
    """Return whether the add-on is registered: whether Blender has its last class."""
    from . import panels

    return _modules(panels)[-1].CLASSES[-1].is_registered


def unregister() -> None:
    """Undo `register`."""
    if not is_registered():
        return
    from . import operators, panels, properties
    from .runtime import gltf_export, handlers

    atexit.unregister(unregister)
    addons = bpy.context.preferences.addons
    if gltf_export.__name__ in addons:
        addons.remove(addons[gltf_export.__name__])
    # The `bpy` module of 4.5 hangs at its exit if handlers stay registered.
    for name, handler in handler_table():
        blender_handlers = getattr(bpy.app.handlers, name)
        if handler in blender_handlers:
            blender_handlers.remove(handler)
    handlers.unregister()
    for package in (panels, operators, properties):
        for module in reversed(_modules(package)):
            if hasattr(module, "unregister"):
                module.unregister()
            for name, draw in getattr(module, "MENUS", {}).items():
                getattr(bpy.types, name).remove(draw)
            for owner, name in getattr(module, "PROPERTIES", {}):
                delattr(owner, name)
            for cls in reversed(module.CLASSES):
                bpy.utils.unregister_class(cls)


def handler_table() -> list[tuple[str, Callable[..., None]]]:
    """Return all handlers in calling order, each with the name of its list in `bpy.app.handlers`."""
    from .evaluation import reopening, side_by_side
    from .jobs import job
    from .operators import training
    from .panels import checks
    from .runtime import handlers
    from .scene import stored_paths, undo, unkeyed_changes
    from .timing import measurements

    # Paths must be restored before models are loaded, so `stored_paths` is the first module.
    modules = (
        stored_paths,
        undo,
        unkeyed_changes,
        job,
        checks,
        handlers,
        reopening,
        side_by_side,
        training,
        measurements,
    )
    return [entry for module in modules for entry in module.HANDLERS.items()]


def _modules(package: ModuleType) -> list[ModuleType]:
    return [import_module(f".{name}", package.__name__) for name in package.MODULES]
