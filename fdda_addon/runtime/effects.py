# SPDX-License-Identifier: GPL-3.0-or-later
"""Applies the effects of transitions to the data of Blender and to the session."""

from contextlib import suppress

import bpy

from ..core.errors import FDDAError, ModelError
from . import modifier_switch, playback_modifier, player_batch, position_buffer
from .player import Player
from .rig_signature import STABLE_MODES
from .session import Character, session
from .transitions import Effect, Event


def apply(effect: Effect, character: Character, error: FDDAError | None) -> None:
    """Apply an effect.

    Args:
        error: the reason of `Effect.REPORT`.

    Raises:
        FDDAError: the model cannot be loaded, or does not fit the rig.
    """
    if effect == Effect.REMOVE_PLAYER:
        player_batch.remove_player(character.buffer_uid)
        character.player = None
    elif effect == Effect.FORGET_CHECK:
        session.passed_checks.pop(character.object_uid, None)
    elif effect == Effect.SCHEDULE_CHECK:
        session.schedule_check()
    elif mesh_object := character.find_object():
        if effect in (Effect.SHOW_MODEL, Effect.SHOW_RIG):
            modifier_switch.switch_modifiers(mesh_object, effect == Effect.SHOW_MODEL)
        elif effect == Effect.DISCONNECT:
            playback_modifier.disconnect(mesh_object)
        elif effect == Effect.CREATE_PLAYER:
            buffer = _ensure_buffer(character, mesh_object)
            character.buffer_uid = buffer.session_uid
            character.reported.clear()
            character.player = Player(mesh_object)
            player_batch.add_player(buffer.session_uid, character.player)
            if mesh_object.mode not in STABLE_MODES:
                session.dispatch(Event.EDIT, character)
        elif effect == Effect.CHECK_RIG:
            reported = set(character.reported)
            character.reported.clear()
            if not character.player.check_rig(mesh_object, reported):
                session.dispatch(Event.OUTDATE, character)
        elif effect == Effect.READ_VISIBILITY:
            modifier_switch.apply_visibility(mesh_object, character.animated)
        elif effect == Effect.TAG_BUFFER:
            buffer = playback_modifier.buffer_of_object(mesh_object)
            if buffer is not None and buffer.session_uid == character.buffer_uid:
                buffer.data.update_tag()
        elif effect == Effect.SHOW_WARNING:
            mesh_object.fdda.status = character.player.reported_warning = character.player.warning
        elif effect == Effect.CLEAR_STATUS:
            mesh_object.fdda.status = ""
        elif effect == Effect.REPORT:
            mesh_object.fdda.mode = "RIG"
            mesh_object.fdda.status = str(error)
            # The terminal may be closed; the effects that follow show the rig all the same.
            with suppress(OSError, ValueError):
                print(f"FDDA is switched off for '{mesh_object.name}': {error}")


def _ensure_buffer(character: Character, mesh_object: bpy.types.Object) -> bpy.types.Object:
    """Return the position buffer of a mesh object; create one if it has no buffer of its own."""
    modifier = playback_modifier.find_modifier(mesh_object)
    if modifier is None:
        raise ModelError(f"The FDDA modifier of '{mesh_object.name}' was removed; bind the model again.")
    # A duplicate still points to the buffer of its original, and an override to the buffer of the linked object.
    buffer = next((o for o in bpy.data.objects if o.session_uid == character.buffer_uid), None)
    if buffer is None or len(buffer.data.vertices) != len(mesh_object.data.vertices):
        buffer = position_buffer.create_buffer(mesh_object)
    if playback_modifier.buffer_of(modifier) != buffer:
        playback_modifier.set_buffer(modifier, buffer)
    playback_modifier.add_rest_position(mesh_object, modifier, keep=mesh_object.fdda.adds_rest_position)
    return buffer


def remove_unused_objects() -> None:
    """Remove the position buffers that no character has."""
    used_uids = {character.buffer_uid for character in session.characters.values()}
    for buffer in [o for o in bpy.data.objects if position_buffer.is_buffer(o) and o.session_uid not in used_uids]:
        position_buffer.remove_buffer(buffer)


def remove_buffers() -> None:
    """Remove all position buffers; a player that is created connects a new one.

    An undo keeps datablocks in memory that are equal in two undo steps. If such a datablock points to an object that
    was created outside of an undo step, it points to freed memory after the undo.
    """
    for mesh_object in [o for o in bpy.data.objects if o.type == "MESH"]:
        playback_modifier.disconnect(mesh_object)
    for character in session.characters.values():
        character.buffer_uid = 0
    remove_unused_objects()


session.apply_effect = apply
