# SPDX-License-Identifier: GPL-3.0-or-later
"""Shows the rigs to the glTF exporter of Blender, which calls these functions of the add-ons in the preferences."""

import bpy

from . import playback
from .session import session


def glTF2_pre_export_callback(_export_settings: dict) -> None:  # noqa: N802
    """Show the rigs of the open file until `glTF2_post_export_callback`."""
    if session.has_bound_objects() and not bpy.app.timers.is_registered(_resume):
        playback.suspend()
        bpy.context.view_layer.update()
        # An export that fails ends without a further call.
        bpy.app.timers.register(_resume, first_interval=0)


def glTF2_post_export_callback(_export_settings: dict) -> None:  # noqa: N802
    """Play the models again; the exporter calls this before it writes the file."""
    if bpy.app.timers.is_registered(_resume):
        bpy.app.timers.unregister(_resume)
        _resume()


def _resume() -> None:
    playback.resume()
    bpy.context.view_layer.update()
