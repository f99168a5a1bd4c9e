# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks rigs for the panels. A timer runs a check after a change; drawing a panel never runs one."""

from dataclasses import dataclass, field, replace

import bpy
from bpy.app.handlers import persistent

from ..core.errors import RigError
from ..properties.recording_options import recording_settings
from ..recording.plan import RecordingSettings
from ..recording.rig_check import RigCheck, check_recordable_rig, problems_beside_others
from ..scene import draw_cache
from ..scene.arrays import REST_MATRIX_ELEMENT, read
from ..scene.scene_rig import SceneRig, armature_of
from .timed_value import timed_values

CHECK_INTERVAL_SECONDS = 0.3
"""Time between two checks of a rig that changes continuously."""


@dataclass
class RigChanges:
    """What may have changed since the last checks of the rigs of the open file; another file ends all.

    Attributes:
        signatures: `_change_signature` at the last check, by session_uid of the mesh object.
        outdated: mesh objects that may have changed in a way that `_change_signature` does not show, by session_uid.
        meshes: names of meshes whose geometry or weights have changed.
    """

    signatures: dict[int, tuple] = field(default_factory=dict)
    outdated: set[int] = field(default_factory=set)
    meshes: set[str] = field(default_factory=set)

    def has_mesh(self, mesh_object: bpy.types.Object) -> bool:
        """Return whether a mesh has changed since its check; False while it is edited."""
        # Reading a large mesh takes long enough to be noticed at each stroke of a brush.
        return mesh_object.mode in {"OBJECT", "POSE"} and mesh_object.data.name in self.meshes


_changes = RigChanges()


@draw_cache.draw_cached
def last_check(scene_rig: SceneRig) -> RigCheck | None:
    """Return the last check of a rig; None before the first. Schedule a new check if the rig may have changed."""
    mesh_object = scene_rig.mesh_object
    uid, check = mesh_object.session_uid, timed_values.last(_check, mesh_object)
    is_outdated = check is None or uid in _changes.outdated or _changes.has_mesh(mesh_object)
    if is_outdated or _changes.signatures[uid] != _change_signature(scene_rig):
        timed_values.get(_check, mesh_object, CHECK_INTERVAL_SECONDS)
    return check


def check_now(scene_rig: SceneRig) -> RigCheck:
    """Check a rig now, without reading unchanged data again, and return the result."""
    return timed_values.compute_now(_check, scene_rig.mesh_object)


def _check(mesh_object: bpy.types.Object) -> RigCheck | None:
    armature_object = armature_of(mesh_object)
    if armature_object is None:
        return None
    scene_rig = SceneRig(mesh_object, armature_object)
    try:
        settings, problems = recording_settings(scene_rig), ()
    except RigError as error:
        settings, problems = RecordingSettings(poses=0), (str(error),)
    uid, signature = mesh_object.session_uid, _change_signature(scene_rig)
    previous = timed_values.last(_check, mesh_object)
    if previous and _changes.signatures[uid][0] == signature[0] and not _changes.has_mesh(mesh_object):
        result = check_recordable_rig(scene_rig, settings, previous)
    else:
        result = check_recordable_rig(scene_rig, settings)
    beside_others = problems_beside_others(scene_rig, settings, result) if result.problems else ()
    result = replace(result, problems=result.problems + problems, problems_beside_others=beside_others)
    _changes.signatures[uid] = signature
    _changes.outdated.discard(uid)
    _changes.meshes.discard(mesh_object.data.name)
    # The same object shows that there is nothing to draw again.
    return previous if previous and _drawn_values(previous) == _drawn_values(result) else result


def _drawn_values(check: RigCheck) -> tuple:
    problems = check.problems, check.problems_beside_others
    return id(check.rig), problems, check.channels, check.replaced_modifiers, check.automatic_controls


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
    return settings.poses > 0, settings.bones_to_pose, settings.extra_inputs


@persistent
def _on_depsgraph_update(_scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    draw_cache.clear()
    if depsgraph.id_type_updated("ACTION"):
        draw_cache.forget_actions()
    if not _changes.signatures:
        return
    _changes.outdated.update(_changes.signatures)
    for update in depsgraph.updates:
        # Armatures are left out: Blender reports them as changed with every pose.
        if isinstance(update.id, bpy.types.Mesh):
            _changes.meshes.add(update.id.name)


@persistent
def _on_undo(*_: object) -> None:
    draw_cache.clear()
    draw_cache.forget_actions()
    _changes.outdated.update(_changes.signatures)
    _changes.meshes.update(mesh.name for mesh in bpy.data.meshes)


@persistent
def _on_load(*_: object) -> None:
    draw_cache.clear_all()
    timed_values.stop()
    for changes in (_changes.signatures, _changes.outdated, _changes.meshes):
        changes.clear()


HANDLERS = {
    "depsgraph_update_post": _on_depsgraph_update,
    "load_post": _on_load,
    "undo_post": _on_undo,
    "redo_post": _on_undo,
}


def unregister() -> None:
    """Remove the timer, all checks, and what was stored for drawing."""
    _on_load()
