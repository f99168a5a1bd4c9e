# SPDX-License-Identifier: GPL-3.0-or-later
"""The handlers: when Blender has evaluated a pose, the models play.

All in one table; `register` adds exactly these, `unregister` removes exactly these. numpy and the modules that play are
imported with the first bound object, not when Blender starts.
"""

import sys
from types import ModuleType

import bpy
from bpy.app.handlers import persistent

_PLAYBACK, _RESTING = f"{__package__}.playback", f"{__package__}.resting"
_count_without_bound = -1


def _playback() -> ModuleType | None:
    """The module `playback`; None while nothing was ever bound in this session."""
    global _count_without_bound
    if _PLAYBACK not in sys.modules:
        count = len(bpy.data.objects)
        if count == _count_without_bound:
            return None
        if not any(o.type == "MESH" and o.fdda.is_bound for o in bpy.data.objects):
            _count_without_bound = count
            return None
    from . import playback

    return playback


@persistent
def _on_frame_begins(scene: bpy.types.Scene, *_: object) -> None:
    if _PLAYBACK in sys.modules:
        sys.modules[_PLAYBACK].rest(scene)


@persistent
def _on_evaluated(_scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    # The graph that is handed in: a render evaluates one of its own.
    if playback := _playback():
        playback.evaluate(depsgraph)


@persistent
def _on_changed(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    _on_evaluated(scene, depsgraph)
    if _RESTING in sys.modules:
        # A simulation may have come.
        sys.modules[_RESTING].forget()


@persistent
def _on_reloaded(*_: object) -> None:
    global _count_without_bound
    _count_without_bound = -1
    if playback := _playback():
        from .saved_rig import resume

        playback.forget()
        # A file holds the true rig, whatever plays in it.
        resume()
        if playback.playing_objects():
            # Without a window nothing evaluates a file that was loaded; here it is safe, no evaluation is under way.
            playback.evaluate(bpy.context.evaluated_depsgraph_get())


@persistent
def _on_linking(*_: object) -> None:
    # A library that is reloaded brings other objects under the same names.
    if playback := _playback():
        playback.forget()


@persistent
def _on_render_begins(*_: object) -> None:
    # A render that shows the rig needs its shape keys; pinning them is not a matter of viewport or render.
    if playback := _playback():
        _pin_outside_renders(playback, False)


@persistent
def _on_render_ended(*_: object) -> None:
    if playback := _playback():
        _pin_outside_renders(playback, True)
        # The cache objects hold the last frame of the render.
        for mesh_object in playback.playing_objects():
            playback.refresh(mesh_object)


@persistent
def _on_save_begins(*_: object) -> None:
    if _playback():
        from .saved_rig import give_back_rigs

        give_back_rigs()


@persistent
def _on_save_ended(*_: object) -> None:
    if _playback():
        from .saved_rig import resume

        resume()


def _pin_outside_renders(playback: ModuleType, pinned: bool) -> None:
    from .switch import pin_shape_keys

    for mesh_object in playback.playing_objects():
        if not mesh_object.fdda.use_in_render:
            pin_shape_keys(mesh_object, pinned)


HANDLERS = {
    "frame_change_pre": _on_frame_begins,
    "frame_change_post": _on_evaluated,
    "depsgraph_update_post": _on_changed,
    "load_post": _on_reloaded,
    "undo_post": _on_reloaded,
    "redo_post": _on_reloaded,
    "render_init": _on_render_begins,
    "render_complete": _on_render_ended,
    "render_cancel": _on_render_ended,
    "save_pre": _on_save_begins,
    "save_post": _on_save_ended,
    "save_post_fail": _on_save_ended,
}
if hasattr(bpy.app.handlers, "blend_import_pre"):
    # 4.3 and later. Before, a library that was reloaded is noticed with the next object that comes or goes.
    HANDLERS["blend_import_pre"] = _on_linking


def register() -> None:
    """Add the handlers; a second call adds nothing."""
    global _count_without_bound
    _count_without_bound = -1
    for name, handler in HANDLERS.items():
        handlers = getattr(bpy.app.handlers, name)
        if handler not in handlers:
            handlers.append(handler)
    if hasattr(bpy.data, "objects"):
        _resume_open_file()
    else:
        # An add-on that is being enabled does not see the file yet.
        bpy.app.timers.register(_resume_open_file, first_interval=0)


def _resume_open_file() -> None:
    """Let the models of a file play that was open before the add-on was there."""
    if _playback():
        from .saved_rig import resume

        resume()


def unregister() -> None:
    """Remove the handlers and forget all bindings; rigs are given back. Left registered they hang the 4.5 module."""
    if bpy.app.timers.is_registered(_resume_open_file):
        bpy.app.timers.unregister(_resume_open_file)
    for name, handler in HANDLERS.items():
        handlers = getattr(bpy.app.handlers, name)
        if handler in handlers:
            handlers.remove(handler)
    if _PLAYBACK in sys.modules:
        from .saved_rig import give_back_rigs

        # Nothing would move their meshes any more.
        give_back_rigs()
        sys.modules[_PLAYBACK].forget()
