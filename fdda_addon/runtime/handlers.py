# SPDX-License-Identifier: GPL-3.0-or-later
"""The handlers: when Blender has evaluated a pose, the models play.

All in one table; `register` adds exactly these, `unregister` removes exactly these.
"""

import bpy
from bpy.app.handlers import persistent

from . import playback, switch


@persistent
def _on_evaluated(_scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    # The graph that is handed in: a render evaluates one of its own.
    playback.evaluate(depsgraph)


@persistent
def _on_reloaded(*_: object) -> None:
    playback.forget()
    if playback.playing_objects():
        # Without a window nothing evaluates a file that was loaded; here it is safe, no evaluation is under way.
        playback.evaluate(bpy.context.evaluated_depsgraph_get())


@persistent
def _on_render_begins(*_: object) -> None:
    # A render that shows the rig needs its shape keys; pinning them is not a matter of viewport or render.
    for mesh_object in _playing_outside_renders():
        switch.pin_shape_keys(mesh_object, False)


@persistent
def _on_render_ended(*_: object) -> None:
    for mesh_object in _playing_outside_renders():
        switch.pin_shape_keys(mesh_object, True)
    # The cache objects hold the last frame of the render.
    for mesh_object in playback.playing_objects():
        playback.refresh(mesh_object)


def _playing_outside_renders() -> list[bpy.types.Object]:
    return [mesh_object for mesh_object in playback.playing_objects() if not mesh_object.fdda.use_in_render]


HANDLERS = {
    "frame_change_post": _on_evaluated,
    "depsgraph_update_post": _on_evaluated,
    "load_post": _on_reloaded,
    "undo_post": _on_reloaded,
    "redo_post": _on_reloaded,
    "render_init": _on_render_begins,
    "render_complete": _on_render_ended,
    "render_cancel": _on_render_ended,
}


def register() -> None:
    """Add the handlers; a second call adds nothing."""
    for name, handler in HANDLERS.items():
        handlers = getattr(bpy.app.handlers, name)
        if handler not in handlers:
            handlers.append(handler)


def unregister() -> None:
    """Remove the handlers and forget all bindings. Left registered they hang the 4.5 module at exit."""
    for name, handler in HANDLERS.items():
        handlers = getattr(bpy.app.handlers, name)
        if handler in handlers:
            handlers.remove(handler)
    playback.forget()
