# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks rigs for the panels. A timer runs a check after a change; drawing a panel never runs one."""

from dataclasses import replace

import bpy
from bpy.app.handlers import persistent

from ..core.errors import RigError
from ..jobs import job
from ..properties.recording_options import recording_settings
from ..recording.plan import RecordingSettings
from ..recording.rig_check import RigCheck, check_recordable_rig
from ..scene import draw_cache
from ..scene.arrays import REST_MATRIX_ELEMENT, read
from ..scene.scene_rig import SceneRig, armature_of

CHECK_INTERVAL_SECONDS = 0.3
"""Time between two checks of a rig that changes continuously."""


class RigChecks:
    """The last checks of the rigs of the open file, and what may have changed since.

    Drawing asks for checks, the handlers report changes, and the timer runs the checks. Another file ends all.

    Attributes:
        checks: by session_uid of the mesh object: the last check, and the `_change_signature` at that time.
        requested: mesh objects that the timer will check, by session_uid.
        outdated: mesh objects that may have changed in a way that `_change_signature` does not show, by session_uid.
        changed_meshes: names of meshes whose geometry or weights have changed.
    """

    def __init__(self) -> None:
        self.checks: dict[int, tuple[RigCheck, tuple]] = {}
        self.requested: set[int] = set()
        self.outdated: set[int] = set()
        self.changed_meshes: set[str] = set()

    def request(self, uid: int, delay: float) -> None:
        """Let the timer check a rig."""
        self.requested.add(uid)
        if not bpy.app.timers.is_registered(_run_requested_checks):
            bpy.app.timers.register(_run_requested_checks, first_interval=delay)

    def store(self, mesh_object: bpy.types.Object, check: "RigCheck", signature: tuple) -> None:
        """Store the check of a rig."""
        self.outdated.discard(mesh_object.session_uid)
        self.changed_meshes.discard(mesh_object.data.name)
        self.checks[mesh_object.session_uid] = check, signature

    def is_mesh_changed(self, mesh_object: bpy.types.Object) -> bool:
        """Return whether a mesh has changed since its check; False while it is edited."""
        # Reading a large mesh takes long enough to be noticed at each stroke of a brush.
        return mesh_object.mode in {"OBJECT", "POSE"} and mesh_object.data.name in self.changed_meshes

    def drawn_values(self) -> dict[int, tuple]:
        """Return the values of all checks that panels draw, by session_uid of the mesh object."""
        return {
            uid: (id(check.rig), check.problems, check.channels, check.replaced_modifiers, check.automatic_controls)
            for uid, (check, _) in self.checks.items()
        }

    def clear(self) -> None:
        """Forget all checks, and remove the timer."""
        if bpy.app.timers.is_registered(_run_requested_checks):
            bpy.app.timers.unregister(_run_requested_checks)
        for state in (self.checks, self.requested, self.outdated, self.changed_meshes):
            state.clear()


_rigs = RigChecks()


@draw_cache.draw_cached
def last_check(scene_rig: SceneRig) -> "RigCheck | None":
    """Return the last check of a rig; None before the first. Schedule a new check if the rig may have changed."""
    uid = scene_rig.mesh_object.session_uid
    check, signature = _rigs.checks.get(uid, (None, ()))
    is_outdated = check is None or uid in _rigs.outdated or signature != _change_signature(scene_rig)
    if is_outdated or _rigs.is_mesh_changed(scene_rig.mesh_object):
        _rigs.request(uid, CHECK_INTERVAL_SECONDS if check else 0.0)
    return check


def check_now(scene_rig: SceneRig) -> "RigCheck":
    """Check a rig now, without reading unchanged data again, and return the result."""
    try:
        settings, problems = recording_settings(scene_rig), ()
    except RigError as error:
        settings, problems = RecordingSettings(poses=0), (str(error),)
    mesh_object, signature = scene_rig.mesh_object, _change_signature(scene_rig)
    previous_check, previous_signature = _rigs.checks.get(mesh_object.session_uid, (None, ((),)))
    if previous_signature[0] == signature[0] and not _rigs.is_mesh_changed(mesh_object):
        result = previous_check.recheck(scene_rig, settings)
    else:
        result = check_recordable_rig(scene_rig, settings)
    result = replace(result, problems=result.problems + problems)
    _rigs.store(mesh_object, result, signature)
    return result


def _run_requested_checks() -> None:
    running_job = job.current()
    previous_values = _rigs.drawn_values()
    meshes = {o.session_uid: o for o in bpy.data.objects if o.type == "MESH"}
    for uid in list(_rigs.requested):
        _rigs.requested.discard(uid)
        mesh_object = meshes.get(uid)
        armature_object = mesh_object and armature_of(mesh_object)
        # A job that changes the scene has changed the pose and the modifiers.
        if armature_object and not (running_job and running_job.changes_scene):
            check_now(SceneRig(mesh_object, armature_object))
    if _rigs.drawn_values() != previous_values:
        job.redraw()


def _change_signature(scene_rig: SceneRig) -> tuple:
    """Return values that are cheap to read and change when a check may change; the first are those of the rest pose."""
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


@persistent
def _on_depsgraph_update(_scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    draw_cache.clear()
    if not _rigs.checks:
        return
    _rigs.outdated.update(_rigs.checks)
    for update in depsgraph.updates:
        # Armatures are left out: Blender reports them as changed with every pose.
        if isinstance(update.id, bpy.types.Mesh):
            _rigs.changed_meshes.add(update.id.name)


@persistent
def _on_undo(*_: object) -> None:
    draw_cache.clear()
    _rigs.outdated.update(_rigs.checks)
    _rigs.changed_meshes.update(mesh.name for mesh in bpy.data.meshes)


@persistent
def _on_load(*_: object) -> None:
    draw_cache.clear_all()
    _rigs.clear()


HANDLERS = {
    "depsgraph_update_post": _on_depsgraph_update,
    "load_post": _on_load,
    "undo_post": _on_undo,
    "redo_post": _on_undo,
}


def unregister() -> None:
    """Remove the timer, all checks, and what was stored for drawing."""
    _on_load()
