# SPDX-License-Identifier: GPL-3.0-or-later
"""Fast and Deep Deformation Approximations for Blender. Importing this needs no bpy; `register` does the work."""

_cli_command: object = None


def register() -> None:
    """Make Blender know the add-on and its command `fdda`. A second call does nothing."""
    global _cli_command
    import bpy

    from . import registration

    registration.register()
    if _cli_command is None:
        _cli_command = bpy.utils.register_cli_command("fdda", _run_command)


def is_registered() -> bool:
    """Whether Blender knows the add-on."""
    return _cli_command is not None


def unregister() -> None:
    """Undo `register`."""
    global _cli_command
    if _cli_command is None:
        return
    import bpy

    from . import registration

    bpy.utils.unregister_cli_command(_cli_command)
    _cli_command = None
    registration.unregister()


def glTF2_pre_export_callback(export_settings: dict) -> None:  # noqa: N802
    """Show the rigs to the glTF exporter of Blender, which calls this function of all enabled add-ons."""
    from .runtime import gltf_export

    gltf_export.glTF2_pre_export_callback(export_settings)


def glTF2_post_export_callback(export_settings: dict) -> None:  # noqa: N802
    """Play the models again."""
    from .runtime import gltf_export

    gltf_export.glTF2_post_export_callback(export_settings)


def _run_command(arguments: list[str]) -> int:
    from .cli.main import main

    return main(arguments, "blender --command fdda")
