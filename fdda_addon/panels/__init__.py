# SPDX-License-Identifier: GPL-3.0-or-later
"""The sidebar panel "FDDA" of the 3D View: a section a module, in the order of the work."""

from importlib import import_module

MODULES: tuple[str, ...] = ()
"""The modules of this package in the order of their sections; each lists its classes in `CLASSES`."""


def register() -> None:
    """Register the classes of all modules."""
    import bpy

    for cls in _classes():
        bpy.utils.register_class(cls)


def unregister() -> None:
    """Undo `register`."""
    import bpy

    for cls in reversed(_classes()):
        bpy.utils.unregister_class(cls)


def _classes() -> list[type]:
    return [cls for name in MODULES for cls in import_module(f".{name}", __name__).CLASSES]
