# SPDX-License-Identifier: GPL-3.0-or-later
"""Translates what Blender reports into events of the session (`transitions`).

`on_evaluate` runs on the thread that evaluates and only writes to evaluated data. Original data are changed after the
evaluation (`on_depsgraph_update`, `on_frame_change`).
"""

from collections.abc import Iterator
from contextlib import contextmanager

import bpy

from . import effects, evaluated_copies, playback_modifier, player_batch
from .depsgraph_changes import DepsgraphChanges, changed_meshes, has_copied_armature
from .model_files import network_of
from .modifier_switch import animated_settings, evaluated_uses_model
from .rig_signature import BONES, MESH, OBJECT, PARENTS, STABLE_MODES
from .session import Character, session
from .transitions import SHOWS_MODEL, Event, State


def on_evaluate(driven_object: bpy.types.Object) -> None:
    """Play the models whose driver an evaluated position buffer has. Raises nothing."""
    player_batch = session.batches.get(driven_object.original.session_uid)
    if player_batch is not None:
        player_batch.play(driven_object)


def on_frame_change(depsgraph: bpy.types.Depsgraph) -> None:
    """Dispatch what the evaluation of a frame has changed, and check the rigs that have changed.

    If only poses and shape keys have changed, nothing is read.
    """
    updated = depsgraph.id_type_updated
    if (
        updated("SCENE")
        or (updated("ARMATURE") and has_copied_armature(depsgraph))
        or (updated("MESH") and changed_meshes(depsgraph))
        or any(c.player is not None and c.player.has_new_copy for c in session.characters.values())
    ):
        _dispatch_changes(depsgraph)
    session.check_rigs()
    _update(depsgraph)
    player_batch.update(frame_changed=True)


def on_depsgraph_update(depsgraph: bpy.types.Depsgraph) -> None:
    """Dispatch what an evaluation without a frame change has changed."""
    _dispatch_changes(depsgraph)
    if bpy.app.background:
        # Timers do not run there.
        session.check_rigs()
    _update(depsgraph)
    player_batch.update(frame_changed=False)


def _dispatch_changes(depsgraph: bpy.types.Depsgraph) -> None:
    """Dispatch the changes of bound objects, their meshes and their armatures."""
    changes = DepsgraphChanges.read(depsgraph)
    for mesh_object, is_edited in changes.mesh_objects:
        character = session.character_of(mesh_object)
        with session.isolated_errors(character):
            _dispatch_object_changes(character, mesh_object, is_edited)
    # The graph of a render reports all datablocks as changed.
    is_render = depsgraph.mode == "RENDER"
    if not is_render:
        edited_uids = {uid for uid, is_edited in changes.meshes.items() if is_edited}
        for object_uid in [uid for uid, (mesh_uid, *_) in session.passed_checks.items() if mesh_uid in edited_uids]:
            del session.passed_checks[object_uid]
    reported_uids = {mesh_object.session_uid for mesh_object, _ in changes.mesh_objects}
    for character in [c for c in session.characters.values() if c.player is not None]:
        player = character.player
        player.has_new_copy = False
        if player.mesh_uid in changes.meshes and player.mask is not None and (mesh_object := character.find_object()):
            with session.isolated_errors(character):
                update_mask(character, mesh_object, weights_changed=True)
        if not is_render and player.armature_uid in changes.armatures:
            session.report_change(character, BONES)
            if changes.armatures[player.armature_uid]:
                session.report_change(character, PARENTS)
        if not is_render and player.mesh_uid in changes.meshes:
            session.report_change(character, MESH)
        if character.object_uid in reported_uids or character.reported or character.state == State.EDITED:
            mesh_object = character.find_object()
            if mesh_object is not None:
                is_stable = mesh_object.mode in STABLE_MODES
                session.dispatch(Event.LEAVE_EDIT if is_stable else Event.EDIT, character)


def _dispatch_object_changes(character: Character, mesh_object: bpy.types.Object, is_edited: bool) -> None:
    """Dispatch the changes of a bound object that an evaluation has reported (`DepsgraphChanges.mesh_objects`)."""
    update_mask(character, mesh_object)
    character.animated = animated_settings(mesh_object)
    if is_edited:
        session.dispatch(Event.EDIT_OBJECT, character)
    player = character.player
    if player is None:
        if character.state in SHOWS_MODEL or mesh_object.fdda.is_playing:
            session.needs_scan = True
    elif is_edited and not (player.fits_object(mesh_object) and _reads_buffer(mesh_object, character)):
        session.dispatch(Event.OUTDATE, character)
    elif is_edited:
        session.report_change(character, OBJECT)


def _reads_buffer(mesh_object: bpy.types.Object, character: Character) -> bool:
    """Return whether the FDDA modifier of a mesh object reads the position buffer of its player."""
    buffer = playback_modifier.buffer_of_object(mesh_object)
    return buffer is not None and buffer.session_uid == character.buffer_uid


def _update(depsgraph: bpy.types.Depsgraph) -> None:
    """Follow added and removed objects, dispatch what players have noted, and apply animated modes."""
    for character in list(session.characters.values()):
        if character.player is not None and character.player.needs_recreation:
            session.dispatch(Event.OUTDATE, character)
    scan()
    # A graph has no id, and Blender reuses the address of a graph for another one.
    depsgraph_key = depsgraph.mode, depsgraph.scene.session_uid, depsgraph.view_layer.name
    if depsgraph.mode == "RENDER":
        for character in [c for c in session.characters.values() if c.player is not None]:
            if mesh_object := character.find_object():
                evaluated_copies.show_rig_to_exporters(mesh_object, depsgraph)
    for character in [c for c in session.characters.values() if c.player is not None]:
        player = character.player
        if depsgraph_key not in player.depsgraph_keys:
            # Its first evaluation leaves out the objects that it did not need while the modifier was off.
            player.depsgraph_keys.add(depsgraph_key)
            session.dispatch(Event.REPLAY, character)
        if player.error:
            session.dispatch(Event.FAIL, character, player.error)
        elif player.warning != player.reported_warning:
            session.dispatch(Event.WARN, character)
    if not session.is_switching:
        for character in [c for c in session.characters.values() if c.animated]:
            if mesh_object := character.find_object():
                with session.isolated_errors(character):
                    _apply_animated_mode(character, mesh_object, depsgraph)


def scan() -> None:
    """Follow the bound objects of the file if objects were added or removed, or if a player was removed."""
    if not session.needs_scan and session.scanned_count == len(bpy.data.objects):
        return
    bound_objects = {o.session_uid: o for o in bpy.data.objects if o.type == "MESH" and o.fdda.is_bound}
    for character in [c for c in session.characters.values() if c.object_uid not in bound_objects]:
        session.dispatch(Event.UNBIND, character)
    for mesh_object in bound_objects.values():
        character = session.character_of(mesh_object)
        with session.isolated_errors(character):
            _scan_object(character, mesh_object)
    effects.remove_unused_objects()
    # Blender also redirects a driver when an object that it reads gets a library override.
    player_batch.update_drivers()
    session.needs_scan, session.scanned_count = False, len(bpy.data.objects)


def _scan_object(character: Character, mesh_object: bpy.types.Object) -> None:
    """Dispatch whether a bound object shows its model."""
    character.animated = animated_settings(mesh_object)
    session.dispatch(Event.EDIT_OBJECT, character)
    # Saved files show the rig, so linked, appended and reloaded objects do not play yet.
    shows_model = mesh_object.fdda.is_playing if character.animated else session.uses_model(mesh_object)
    if not shows_model:
        if character.state in SHOWS_MODEL or playback_modifier.buffer_of_object(mesh_object) is not None:
            session.dispatch(Event.SHOW_RIG, character)
    elif character.player is None:
        # Not CHOOSE_MODEL: only the user plays a model again that has failed.
        session.dispatch(Event.ANIMATE_MODEL, character)
    elif not (mesh_object.fdda.is_playing and _reads_buffer(mesh_object, character)):
        session.dispatch(Event.OUTDATE, character)


def _apply_animated_mode(character: Character, mesh_object: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> None:
    """Dispatch the animated or driven mode of an object if it differs from what the object shows."""
    evaluated = mesh_object.evaluated_get(depsgraph)
    if not evaluated.is_evaluated or (depsgraph.mode == "RENDER" and not mesh_object.fdda.use_in_render):
        return
    if session.overriding_mode(mesh_object.session_uid):
        return
    uses_model = evaluated_uses_model(evaluated, depsgraph, character.animated)
    if uses_model == (character.state in SHOWS_MODEL):
        return
    session.dispatch(Event.ANIMATE_MODEL if uses_model else Event.SHOW_RIG, character)
    if uses_model == (character.state in SHOWS_MODEL):
        # The first evaluation only finds that the position buffer is needed; the next one evaluates it.
        session.is_switching = True
        try:
            depsgraph.update()
        finally:
            session.is_switching = False
        session.dispatch(Event.OUTDATE, character)
        scan()


def update_mask(character: Character, mesh_object: bpy.types.Object, *, weights_changed: bool = False) -> None:
    """Dispatch whether the mask of a bound object has changed."""
    player = character.player
    if player is not None and player.update_mask(mesh_object, weights_changed):
        session.dispatch(Event.REPLAY, character)


def has_outdated_model(mesh_object: bpy.types.Object) -> bool:
    """Return whether an object plays a model whose file has been replaced since it was loaded."""
    character = session.characters.get(mesh_object.session_uid)
    player = character and character.player
    return player is not None and player.network is not network_of(mesh_object)


def reload_model(mesh_object: bpy.types.Object) -> None:
    """Play an object with the model that it is bound to now."""
    session.dispatch(Event.OUTDATE, session.character_of(mesh_object))


def suspend() -> None:
    """Show all rigs of the open file as if no model played; as many calls of `resume` start playback again.

    Linked objects are restored too, because Blender saves the differences of a library override from them.
    """
    scan()
    session.dispatch(Event.SUSPEND)
    session.suspension_count += 1


def resume() -> None:
    """Play the models of the open file again, unless another save has suspended them too."""
    session.suspension_count = max(session.suspension_count - 1, 0)
    if session.suspension_count:
        return
    session.dispatch(Event.RESUME)
    session.needs_scan = True
    scan()


def begin_undo() -> None:
    """Remove our objects, so that no undo step refers to one."""
    session.reset(keep_checks=True)
    effects.remove_buffers()


def end_undo() -> None:
    """Play the models of the undo step; it may have restored position buffers whose evaluated copies are outdated."""
    begin_undo()
    scan()


@contextmanager
def suspended_playback() -> Iterator[None]:
    """Show the rigs of the open file and remove our data in the block, so that parts of the file can be written."""
    suspend()
    try:
        effects.remove_buffers()
        yield
    finally:
        resume()
