# SPDX-License-Identifier: GPL-3.0-or-later
"""The operators: a button each. Poll, gather, call, report; the work is done by the modules below."""

from importlib import import_module

MODULES: tuple[str, ...] = ("job", "trainer_environment")
"""The modules of this package; each lists its classes in `CLASSES`."""


def register() -> None:
    """Register the classes of all modules."""
    import bpy

    from . import job_state

    for cls in _classes():
        bpy.utils.register_class(cls)
    job_state.register()


def unregister() -> None:
    """Undo `register`."""
    import bpy

    from . import job_state

    job_state.unregister()
    for cls in reversed(_classes()):
        bpy.utils.unregister_class(cls)


def _classes() -> list[type]:
    return [cls for name in MODULES for cls in import_module(f".{name}", __name__).CLASSES]
