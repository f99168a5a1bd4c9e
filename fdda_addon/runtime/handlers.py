# SPDX-License-Identifier: GPL-3.0-or-later
"""What Blender calls: the getter that plays, inside an evaluation, and the handlers, after it.

`registration.handler_table` adds and removes the handlers. numpy and the modules that play are imported with the first
bound object, not when Blender starts.
"""

import sys
from types import ModuleType

import bpy
from bpy.app.handlers import persistent

_PLAYBACK = f"{__package__}.playback"
_MODEL_FILES = f"{__package__}.model_files"
_count_without_bound = -1


def _playback() -> ModuleType | None:
    """The module `playback`; None while nothing was ever bound in this session."""
    global _count_without_bound
    if _PLAYBACK in sys.modules:
        return sys.modules[_PLAYBACK]
    count = len(bpy.data.objects)
    if count == _count_without_bound:
        return None
    if not any(o.type == "MESH" and o.fdda.is_bound for o in bpy.data.objects):
        _count_without_bound = count
        return None
    from . import playback

    return playback


def _play(buffer: bpy.types.Object) -> float:
    """The getter that the driver of a position buffer reads: what it is for is that it is called."""
    if buffer.is_evaluated and _PLAYBACK in sys.modules:
        sys.modules[_PLAYBACK].play(buffer)
    return 0.0


@persistent
def _on_frame(_scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    if playback := _playback():
        playback.note_data(depsgraph)
        playback.follow(depsgraph)
        playback.gather(frame_changed=True)


@persistent
def _on_changed(_scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    if playback := _playback():
        playback.note_changes(depsgraph)
        playback.follow(depsgraph)
        playback.gather(frame_changed=False)


def _play_anew() -> None:
    global _count_without_bound
    _count_without_bound = -1
    if playback := _playback():
        playback.resume()


@persistent
def _on_loaded(*_: object) -> None:
    if _PLAYBACK in sys.modules:
        sys.modules[_PLAYBACK].forget_rigs()
    # A file holds the true rig, whatever plays in it.
    _play_anew()
    if _MODEL_FILES in sys.modules:
        sys.modules[_MODEL_FILES].release_unused()


@persistent
def _on_undo_begins(*_: object) -> None:
    if playback := _playback():
        playback.remove_buffers()


@persistent
def _on_undone(*_: object) -> None:
    # The step that was read may have brought position buffers back, of which evaluated copies are left from before.
    _on_undo_begins()
    _play_anew()


@persistent
def _on_linking(*_: object) -> None:
    # A library that is reloaded brings other objects under the same names.
    if playback := _playback():
        playback.forget_rigs()


@persistent
def _on_save_begins(*_: object) -> None:
    if playback := _playback():
        playback.give_back_rigs()


@persistent
def _on_save_ended(*_: object) -> None:
    if playback := _playback():
        playback.resume()


HANDLERS = {
    "frame_change_post": _on_frame,
    "depsgraph_update_post": _on_changed,
    "load_post": _on_loaded,
    "undo_pre": _on_undo_begins,
    "redo_pre": _on_undo_begins,
    "undo_post": _on_undone,
    "redo_post": _on_undone,
    "blend_import_pre": _on_linking,
    "save_pre": _on_save_begins,
    "save_post": _on_save_ended,
    "save_post_fail": _on_save_ended,
}


def register() -> None:
    """Add the getter, and let what is bound in the open file play."""
    global _count_without_bound
    _count_without_bound = -1
    bpy.types.Object.fdda_playback = bpy.props.FloatProperty(get=_play, options={"HIDDEN", "SKIP_SAVE"})
    if hasattr(bpy.data, "objects"):
        _resume_open_file()
    else:
        # An add-on that is being enabled does not see the file yet.
        bpy.app.timers.register(_resume_open_file, first_interval=0)


def _resume_open_file() -> None:
    """Let the models of a file play that was open before the add-on was there."""
    if playback := _playback():
        playback.resume()


def unregister() -> None:
    """Remove getter and position buffers; rigs are given back."""
    if bpy.app.timers.is_registered(_resume_open_file):
        bpy.app.timers.unregister(_resume_open_file)
    if _PLAYBACK in sys.modules:
        # Nothing would move their meshes any more.
        sys.modules[_PLAYBACK].give_back_rigs()
        sys.modules[_PLAYBACK].remove_buffers()
    del bpy.types.Object.fdda_playback
