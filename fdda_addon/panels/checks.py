# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks rigs for the panels. A timer runs a check after a change; drawing a panel never runs one."""

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
"""Time between two checks of a rig that changes continuously."""

_checks: dict[int, "tuple[RigCheck, tuple]"] = {}
"""Last check of each rig, with the `_change_signature` at that time, by session_uid of the mesh object."""
_requested: set[int] = set()
"""Mesh objects that the timer will check, by session_uid."""
_outdated: set[int] = set()
"""Mesh objects that may have changed in a way that `_change_signature` does not show, by session_uid."""
_changed_meshes: set[str] = set()
"""Names of meshes whose geometry or weights have changed."""


@draw_cache.draw_cached
def last_check(scene_rig: SceneRig) -> "RigCheck | None":
    """Return the last check of a rig; None before the first. Schedule a new check if the rig may have changed."""
    uid = scene_rig.mesh_object.session_uid
    stored = _checks.get(uid)
    if stored is None or uid in _outdated or stored[1] != _change_signature(scene_rig) or _is_mesh_changed(scene_rig):
        _requested.add(uid)
        if not bpy.app.timers.is_registered(_run_requested_checks):
            bpy.app.timers.register(_run_requested_checks, first_interval=CHECK_INTERVAL_SECONDS if stored else 0.0)
    return stored[0] if stored else None


def check_now(scene_rig: SceneRig) -> "RigCheck":
    """Check a rig now, without reading unchanged data again, and return the result."""
    from ..recording.plan import RecordingSettings
    from ..recording.rig_check import check_recordable_rig

    try:
        settings, problems = recording_settings(scene_rig), ()
    except RigError as error:
        settings, problems = RecordingSettings(poses=0), (str(error),)
    uid, signature = scene_rig.mesh_object.session_uid, _change_signature(scene_rig)
    stored = _checks.get(uid)
    is_rest_unchanged = stored is not None and stored[1][0] == signature[0] and not _is_mesh_changed(scene_rig)
    result = stored[0].recheck(scene_rig, settings) if is_rest_unchanged else check_recordable_rig(scene_rig, settings)
    result = replace(result, problems=result.problems + problems)
    _outdated.discard(uid)
    _changed_meshes.discard(scene_rig.mesh_object.data.name)
    _checks[uid] = (result, signature)
    return result


def _run_requested_checks() -> None:
    running_job = job.current()
    previous_values = _drawn_values()
    meshes = {o.session_uid: o for o in bpy.data.objects if o.type == "MESH"}
    for uid in list(_requested):
        _requested.discard(uid)
        mesh_object = meshes.get(uid)
        armature_object = mesh_object and armature_of(mesh_object)
        # A job that changes the scene has changed the pose and the modifiers.
        if armature_object and not (running_job and running_job.changes_scene):
            check_now(SceneRig(mesh_object, armature_object))
    if _drawn_values() != previous_values:
        job.redraw()


def _drawn_values() -> dict[int, tuple]:
    """Return the values of all checks that panels draw, by session_uid of the mesh object."""
    return {
        uid: (id(check.rig), check.problems, check.channels, check.replaced_modifiers, check.automatic_controls)
        for uid, (check, _) in _checks.items()
    }


def _change_signature(scene_rig: SceneRig) -> tuple:
    """Return values that are cheap to read and change when a check may change; the first are those of the rest pose."""
    from ..scene.arrays import REST_MATRIX_ELEMENT, read

    mesh_object, armature_object = scene_rig.mesh_object, scene_rig.armature_object
    mesh, bones = mesh_object.data, armature_object.data.bones
    rest_values = (
        mesh.name,
        len(mesh.vertices),
        len(mesh_object.vertex_groups),
        armature_object.name,
        len(bones),
        read(bones, REST_MATRIX_ELEMENT).tobytes(),
        tuple(mesh_object.scale),
        tuple(armature_object.scale),
    )
    modifiers = tuple((m.name, m.type, m.show_viewport) for m in mesh_object.modifiers)
    object_state = (
        mesh_object.mode,
        armature_object.mode,
        mesh_object.visible_get(),
        armature_object.data.pose_position,
    )
    return rest_values, modifiers, object_state, mesh_object.fdda.is_playing, _sampling_settings(scene_rig)


def _sampling_settings(scene_rig: SceneRig) -> tuple:
    """Return the settings that choose the bones and extra inputs of random poses."""
    try:
        settings = recording_settings(scene_rig)
    except RigError as error:
        return (str(error),)
    return settings.poses > 0, settings.sample, settings.controls


def _is_mesh_changed(scene_rig: SceneRig) -> bool:
    mesh_object = scene_rig.mesh_object
    # Reading a large mesh takes long enough to be noticed at each stroke of a brush.
    if mesh_object.mode not in {"OBJECT", "POSE"} or not _changed_meshes:
        return False
    return mesh_object.data.name in _changed_meshes


@persistent
def _on_depsgraph_update(_scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    draw_cache.clear()
    if not _checks:
        return
    _outdated.update(_checks)
    for update in depsgraph.updates:
        # Armatures are left out: Blender reports them as changed with every pose.
        if isinstance(update.id, bpy.types.Mesh):
            _changed_meshes.add(update.id.name)


@persistent
def _on_undo(*_: object) -> None:
    draw_cache.clear()
    _outdated.update(_checks)
    _changed_meshes.update(mesh.name for mesh in bpy.data.meshes)


@persistent
def _on_load(*_: object) -> None:
    draw_cache.clear()
    for state in (_checks, _requested, _outdated, _changed_meshes):
        state.clear()


HANDLERS = {
    "depsgraph_update_post": _on_depsgraph_update,
    "load_post": _on_load,
    "undo_post": _on_undo,
    "redo_post": _on_undo,
}


def unregister() -> None:
    """Remove the timer and all checks."""
    if bpy.app.timers.is_registered(_run_requested_checks):
        bpy.app.timers.unregister(_run_requested_checks)
    _on_load()
