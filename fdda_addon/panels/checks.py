# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks of rigs for panels to draw. A timer runs a check after a change; drawing never does."""

from dataclasses import replace
from typing import TYPE_CHECKING

import bpy
from bpy.app.handlers import persistent

from ..core.errors import RigError
from ..jobs import job
from ..properties.recording_options import recording_settings
from ..scene import draw_cache
from ..scene.scene_rig import SceneRig, armature_of

if TYPE_CHECKING:  # Blender starts without numpy.
    from ..recording.rig_check import RigCheck

CHECK_INTERVAL_SECONDS = 0.3
"""Shortest time between two checks of a rig that keeps changing."""

_checks: dict[int, "tuple[RigCheck, tuple]"] = {}
"""Last check, and `_change_signature` at that time, by session_uid of the mesh object."""
_requested: set[int] = set()
_outdated: set[int] = set()
"""Mesh objects to check again for a reason that `_change_signature` does not contain, by session_uid."""
_changed_meshes: set[str] = set()
"""Names of meshes whose geometry or weights have changed."""


@draw_cache.draw_cached
def last_check(scene_rig: SceneRig) -> "RigCheck | None":
    """Return the last check of a rig, None before the first. Schedule another one after a change."""
    uid = scene_rig.mesh_object.session_uid
    stored = _checks.get(uid)
    if stored is None or uid in _outdated or stored[1] != _change_signature(scene_rig) or _is_mesh_changed(scene_rig):
        _requested.add(uid)
        if not bpy.app.timers.is_registered(_run_requested_checks):
            bpy.app.timers.register(_run_requested_checks, first_interval=CHECK_INTERVAL_SECONDS if stored else 0.0)
    return stored[0] if stored else None


def check_now(scene_rig: SceneRig) -> "RigCheck":
    """Check a rig now. What has not changed is not read again."""
    from ..recording.plan import RecordingSettings
    from ..recording.rig_check import check_recordable_rig

    try:
        settings, problems = recording_settings(scene_rig), ()
    except RigError as error:
        settings, problems = RecordingSettings(poses=0), (str(error),)
    uid, signature = scene_rig.mesh_object.session_uid, _change_signature(scene_rig)
    stored = _checks.get(uid)
    same_rest = stored is not None and stored[1][0] == signature[0] and not _is_mesh_changed(scene_rig)
    result = stored[0].recheck(scene_rig, settings) if same_rest else check_recordable_rig(scene_rig, settings)
    result = replace(result, problems=result.problems + problems)
    _outdated.discard(uid)
    _changed_meshes.discard(scene_rig.mesh_object.data.name)
    _checks[uid] = (result, signature)
    return result


def _run_requested_checks() -> None:
    running = job.current()
    before = _drawn_values()
    meshes = {o.session_uid: o for o in bpy.data.objects if o.type == "MESH"}
    for uid in list(_requested):
        _requested.discard(uid)
        mesh_object = meshes.get(uid)
        armature_object = mesh_object and armature_of(mesh_object)
        # A job that borrows the scene has changed the pose and the modifiers.
        if armature_object and not (running and running.changes_scene):
            check_now(SceneRig(mesh_object, armature_object))
    if _drawn_values() != before:
        job.redraw()


def _drawn_values() -> dict[int, tuple]:
    """Return what panels draw of the checks."""
    return {
        uid: (id(check.rig), check.problems, check.channels, check.replaced_modifiers, check.automatic_controls)
        for uid, (check, _) in _checks.items()
    }


def _change_signature(scene_rig: SceneRig) -> tuple:
    """Return cheap values that change when a check may change: (those of the rest pose, all others)."""
    from ..scene.arrays import REST_MATRIX, read

    mesh_object, armature_object = scene_rig.mesh_object, scene_rig.armature_object
    mesh, bones = mesh_object.data, armature_object.data.bones
    rest = (
        mesh.name,
        len(mesh.vertices),
        len(mesh_object.vertex_groups),
        armature_object.name,
        len(bones),
        read(bones, REST_MATRIX).tobytes(),
        tuple(mesh_object.scale),
        tuple(armature_object.scale),
    )
    modifiers = tuple((m.name, m.type, m.show_viewport) for m in mesh_object.modifiers)
    state = (mesh_object.mode, armature_object.mode, mesh_object.visible_get(), armature_object.data.pose_position)
    return rest, modifiers, state, mesh_object.fdda.is_playing, _sampling_settings(scene_rig)


def _sampling_settings(scene_rig: SceneRig) -> tuple:
    """Return the settings that choose what random poses move."""
    try:
        settings = recording_settings(scene_rig)
    except RigError as error:
        return (str(error),)
    return settings.poses > 0, settings.sample, settings.controls


def _is_mesh_changed(scene_rig: SceneRig) -> bool:
    mesh_object = scene_rig.mesh_object
    # Reading a large mesh takes a moment, which would be noticed at each stroke of a brush.
    if mesh_object.mode not in {"OBJECT", "POSE"} or not _changed_meshes:
        return False
    return mesh_object.data.name in _changed_meshes


@persistent
def _on_changed(_scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    draw_cache.clear()
    if not _checks:
        return
    _outdated.update(_checks)
    for update in depsgraph.updates:
        # Armatures are left out: Blender reports them as changed with every pose.
        if isinstance(update.id, bpy.types.Mesh):
            _changed_meshes.add(update.id.name)


@persistent
def _on_undone(*_: object) -> None:
    draw_cache.clear()
    _outdated.update(_checks)
    _changed_meshes.update(mesh.name for mesh in bpy.data.meshes)


@persistent
def _on_loaded(*_: object) -> None:
    draw_cache.clear()
    for state in (_checks, _requested, _outdated, _changed_meshes):
        state.clear()


HANDLERS = {
    "depsgraph_update_post": _on_changed,
    "load_post": _on_loaded,
    "undo_post": _on_undone,
    "redo_post": _on_undone,
}


def unregister() -> None:
    """Remove the timer and all checks."""
    if bpy.app.timers.is_registered(_run_requested_checks):
        bpy.app.timers.unregister(_run_requested_checks)
    _on_loaded()
