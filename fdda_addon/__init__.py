# SPDX-License-Identifier: GPL-3.0-or-later
"""Fast and Deep Deformation Approximations for Blender. Importing this needs no bpy; `register` does the work."""

import atexit

_cli_command: object = None


def register() -> None:
    """Make Blender know the add-on: properties, handlers and the command `fdda`. A second call does nothing."""
    global _cli_command
    if is_registered():
        return
    import bpy

    from . import class_lists, operators, panels, preferences, properties
    from .runtime import handlers

    properties.register()
    preferences.register()
    for package in (operators, panels):
        class_lists.register(package)
    handlers.register()
    _cli_command = bpy.utils.register_cli_command("fdda", _run_command)
    if not bpy.app.binary_path:
        # Blender itself disables its add-ons before it ends; here, at its exit, nothing of it is left.
        atexit.register(unregister)


def is_registered() -> bool:
    """Whether Blender knows the add-on."""
    return _cli_command is not None


def unregister() -> None:
    """Undo `register`."""
    global _cli_command
    if not is_registered():
        return
    import bpy

    from . import class_lists, operators, panels, preferences, properties
    from .runtime import handlers

    atexit.unregister(unregister)
    bpy.utils.unregister_cli_command(_cli_command)
    _cli_command = None
    handlers.unregister()
    for package in (panels, operators):
        class_lists.unregister(package)
    preferences.unregister()
    properties.unregister()


def _run_command(arguments: list[str]) -> int:
    from .cli import main

    return main(arguments, "blender --command fdda")
