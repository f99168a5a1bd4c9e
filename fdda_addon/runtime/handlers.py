# SPDX-License-Identifier: GPL-3.0-or-later
"""The entry points that Blender calls: the getter that plays models during an evaluation, and the handlers after it.

Each only passes on what Blender reports. `registration.handler_table` adds and removes the handlers.
"""

import bpy
from bpy.app.handlers import persistent

from . import model_files, playback
from .session import session


def _get_playback_property(driven_object: bpy.types.Object) -> float:
    """Play the models of an evaluated object. The value is 0, because a driver variable has to be a number."""
    if driven_object.is_evaluated and session.characters:
        playback.on_evaluate(driven_object)
    return 0.0


@persistent
def _on_frame_change_post(_scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    if session.has_bound_objects():
        playback.on_frame_change(depsgraph)


@persistent
def _on_depsgraph_update_post(_scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    if session.has_bound_objects():
        playback.on_depsgraph_update(depsgraph)


@persistent
def _on_load_post(*_: object) -> None:
    session.reset()
    if session.networks:
        model_files.release_unused_networks()
    if session.has_bound_objects():
        playback.scan()


@persistent
def _on_undo_pre(*_: object) -> None:
    if session.has_bound_objects():
        playback.begin_undo()


@persistent
def _on_undo_post(*_: object) -> None:
    session.reset(keep_checks=True)
    if session.has_bound_objects():
        playback.end_undo()


@persistent
def _on_blend_import_pre(*_: object) -> None:
    # Reloading a library replaces objects by new objects with the same names.
    session.reset()


@persistent
def _on_save_pre(*_: object) -> None:
    if session.has_bound_objects():
        playback.suspend()


@persistent
def _on_save_post(*_: object) -> None:
    if session.has_bound_objects():
        playback.resume()


HANDLERS = {
    "frame_change_post": _on_frame_change_post,
    "depsgraph_update_post": _on_depsgraph_update_post,
    "load_post": _on_load_post,
    "undo_pre": _on_undo_pre,
    "redo_pre": _on_undo_pre,
    "undo_post": _on_undo_post,
    "redo_post": _on_undo_post,
    "blend_import_pre": _on_blend_import_pre,
    "save_pre": _on_save_pre,
    "save_post": _on_save_post,
    "save_post_fail": _on_save_post,
}


def register() -> None:
    """Add the playback property, and play the bound models of the open file."""
    session.reset()
    bpy.types.Object.fdda_playback = bpy.props.FloatProperty(
        get=_get_playback_property, options={"HIDDEN", "SKIP_SAVE"}
    )
    if hasattr(bpy.data, "objects"):
        _on_load_post()
    else:
        # Blender restricts access to the file while it enables an add-on.
        bpy.app.timers.register(_on_load_post, first_interval=0)


def unregister() -> None:
    """Restore the rigs, and remove the position buffers and the playback property."""
    for timer in (_on_load_post, session.check_timer):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
    if session.has_bound_objects():
        # Without the property nothing updates the buffers.
        playback.suspend()
        playback.effects.remove_buffers()
    session.reset()
    del bpy.types.Object.fdda_playback
