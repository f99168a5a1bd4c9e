# SPDX-License-Identifier: GPL-3.0-or-later
"""The entry points that Blender calls: the getter that plays models during an evaluation, and the handlers after it.

`registration.handler_table` adds and removes the handlers. numpy and the playback modules are imported with the first
bound object, not when Blender starts.
"""

import sys
from types import ModuleType

import bpy
from bpy.app.handlers import persistent

_PLAYBACK_MODULE = f"{__package__}.playback"
_MODEL_FILES_MODULE = f"{__package__}.model_files"
_object_count_without_binding = -1
"""Number of objects in the file at the last check, if none of them was bound; else -1."""


def _import_playback() -> ModuleType | None:
    """Import and return the module `playback`; return None if no object was bound in this session."""
    global _object_count_without_binding
    if _PLAYBACK_MODULE in sys.modules:
        return sys.modules[_PLAYBACK_MODULE]
    object_count = len(bpy.data.objects)
    if object_count == _object_count_without_binding:
        return None
    if not any(o.type == "MESH" and o.fdda.is_bound for o in bpy.data.objects):
        _object_count_without_binding = object_count
        return None
    from . import playback

    return playback


def _get_playback_property(driven_object: bpy.types.Object) -> float:
    """Play the models of an evaluated object. The value is 0, because a driver variable has to be a number."""
    if driven_object.is_evaluated and _PLAYBACK_MODULE in sys.modules:
        sys.modules[_PLAYBACK_MODULE].on_evaluate(driven_object)
    return 0.0


@persistent
def _on_frame_change_post(_scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    if playback := _import_playback():
        playback.on_frame_change(depsgraph)


@persistent
def _on_depsgraph_update_post(_scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    if playback := _import_playback():
        playback.on_depsgraph_update(depsgraph)


def _resume_any_file() -> None:
    """Play the models of the open file, also if it is another file than before."""
    global _object_count_without_binding
    _object_count_without_binding = -1
    _resume()


def _resume() -> None:
    if playback := _import_playback():
        playback.resume()


@persistent
def _on_load_post(*_: object) -> None:
    if playback := sys.modules.get(_PLAYBACK_MODULE):
        playback.registry.reset_rigs()
    # Files are saved with the rigs shown, even if models played.
    _resume_any_file()
    if _MODEL_FILES_MODULE in sys.modules:
        sys.modules[_MODEL_FILES_MODULE].release_unused_networks()


@persistent
def _on_undo_pre(*_: object) -> None:
    if playback := _import_playback():
        playback.registry.remove_buffers()


@persistent
def _on_undo_post(*_: object) -> None:
    # The undo step may have restored position buffers whose evaluated copies are outdated.
    _on_undo_pre()
    _resume_any_file()


@persistent
def _on_blend_import_pre(*_: object) -> None:
    # Reloading a library replaces objects by new objects with the same names.
    if playback := _import_playback():
        playback.registry.reset_rigs()


@persistent
def _on_save_pre(*_: object) -> None:
    if playback := _import_playback():
        playback.restore_rigs()


@persistent
def _on_save_post(*_: object) -> None:
    _resume()


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
    global _object_count_without_binding
    _object_count_without_binding = -1
    bpy.types.Object.fdda_playback = bpy.props.FloatProperty(
        get=_get_playback_property, options={"HIDDEN", "SKIP_SAVE"}
    )
    if hasattr(bpy.data, "objects"):
        _resume()
    else:
        # Blender restricts access to the file while it enables an add-on.
        bpy.app.timers.register(_resume, first_interval=0)


def unregister() -> None:
    """Restore the rigs, and remove the position buffers and the playback property."""
    if bpy.app.timers.is_registered(_resume):
        bpy.app.timers.unregister(_resume)
    if playback := sys.modules.get(_PLAYBACK_MODULE):
        # Without the property nothing updates the buffers.
        playback.restore_rigs()
        playback.registry.remove_buffers()
    del bpy.types.Object.fdda_playback
