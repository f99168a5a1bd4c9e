# SPDX-License-Identifier: GPL-3.0-or-later
"""The players of the open file, found from the properties of its objects.

Players hold names and session ids, never references to RNA objects, which an undo or the load of a file invalidates.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import bpy

from ..core.errors import FDDAError, ModelError
from . import modifier_switch, playback_modifier, position_buffer, rig_signature
from .mode_override import uses_model
from .player import Player
from .player_batch import PlayerBatches, is_batch_driver

players: dict[int, Player] = {}
"""The players, by the session ids of their position buffers."""
animated_settings: dict[int, frozenset[str]] = {}
"""By the session id of each bound object: the result of `modifier_switch.animated_settings`."""
batches = PlayerBatches()
edited_objects: set[int] = set()
"""Session ids of the bound objects that are in a mode that changes their mesh, such as edit mode."""
_scanned_object_count = -1
"""Number of objects in the file at the last scan; -1 to scan after the next evaluation."""
_is_suspended = False
"""Whether `scan` does nothing."""


def find_player(mesh_object: bpy.types.Object) -> tuple[int, Player | None]:
    """Find the player of an object and the session id of its position buffer."""
    matches = ((uid, player) for uid, player in players.items() if player.object_uid == mesh_object.session_uid)
    return next(matches, (0, None))


def remove_player(buffer_uid: int) -> None:
    """Remove a player; the next scan creates another one if its object still plays."""
    batches.unbatch(buffer_uid)
    del players[buffer_uid]
    request_rescan()


def recreate_player(mesh_object: bpy.types.Object) -> None:
    """Create the player of an object again after the next evaluation."""
    uid, player = find_player(mesh_object)
    if player is not None:
        remove_player(uid)
    request_rescan()


def reset_players() -> None:
    """Remove all players; the next scan creates them again."""
    players.clear()
    batches.clear()
    animated_settings.clear()
    edited_objects.clear()
    request_rescan()


def reset_rigs() -> None:
    """Create all players and check all rigs again, because names may refer to other datablocks now."""
    rig_signature.invalidate_all()
    reset_players()


def request_rescan() -> None:
    """Scan the file after the next evaluation, even if no object was added or removed."""
    global _scanned_object_count
    _scanned_object_count = -1


def update_batches(*, frame_changed: bool) -> None:
    """Batch the players that move together while frames change, and unbatch the others."""
    global _scanned_object_count
    # A new or removed batch driver is no reason to scan.
    _scanned_object_count += batches.update(players, frame_changed)


@contextmanager
def suspended_scans() -> Iterator[None]:
    """Create no players in the block, because operators evaluate the file before they begin."""
    global _is_suspended
    _is_suspended = True
    try:
        yield
    finally:
        _is_suspended = False


def scan() -> None:
    """Find the bound objects if objects were added or removed, and create the missing players."""
    global _scanned_object_count
    if _is_suspended or _scanned_object_count == len(bpy.data.objects):
        return
    batches.clear()
    used_buffers: set[int] = set()
    for mesh_object in [o for o in bpy.data.objects if o.type == "MESH" and o.fdda.is_bound]:
        with isolated_errors(mesh_object):
            _scan_object(mesh_object, used_buffers)
    remove_unused_objects()
    _scanned_object_count = len(bpy.data.objects)


def _scan_object(mesh_object: bpy.types.Object, used_buffers: set[int]) -> None:
    """Create the player of a bound object that plays and has none.

    Args:
        mesh_object: the object.
        used_buffers: session ids of the position buffers of other objects; the buffer of the object is added.
    """
    animated_settings[mesh_object.session_uid] = animated = modifier_switch.animated_settings(mesh_object)
    modifier_switch.apply_visibility(mesh_object, animated)
    if not animated and mesh_object.fdda.is_playing != uses_model(mesh_object):
        # Saved files show the rig, so linked, appended and reloaded objects do not play yet.
        modifier_switch.switch_modifiers(mesh_object)
    if not mesh_object.fdda.is_playing:
        modifier_switch.disconnect_visible(mesh_object, animated)
        return
    buffer = _ensure_buffer(mesh_object, used_buffers)
    player = players.get(buffer.session_uid)
    if player is None or player.object_uid != mesh_object.session_uid:
        players[buffer.session_uid] = Player(mesh_object, buffer)
        if mesh_object.mode not in rig_signature.STABLE_MODES:
            edited_objects.add(mesh_object.session_uid)
    else:
        # Blender redirects the driver when an object that it reads gets a library override.
        player.update_driver(mesh_object, buffer)


def _ensure_buffer(mesh_object: bpy.types.Object, used_buffers: set[int]) -> bpy.types.Object:
    """Return the position buffer of a mesh object; create one if it has no buffer of its own."""
    modifier = playback_modifier.find_modifier(mesh_object)
    if modifier is None:
        raise ModelError(f"The FDDA modifier of '{mesh_object.name}' was removed; bind the model again.")
    buffer = playback_modifier.buffer_of(modifier)
    is_own = buffer is not None and position_buffer.is_buffer(buffer) and buffer.session_uid not in used_buffers
    if not is_own or len(buffer.data.vertices) != len(mesh_object.data.vertices):
        # A duplicate still points to the buffer of its original, and an override to the buffer of the linked object.
        buffer = position_buffer.create_buffer(mesh_object)
        playback_modifier.set_buffer(modifier, buffer)
    used_buffers.add(buffer.session_uid)
    return buffer


def remove_unused_objects() -> None:
    """Remove the position buffers that no modifier reads, and the batch drivers that play no batch."""
    used_buffers = playback_modifier.used_buffers()
    for buffer in [o for o in bpy.data.objects if position_buffer.is_buffer(o) and o not in used_buffers]:
        players.pop(buffer.session_uid, None)
        position_buffer.remove_buffer(buffer)
    for batch_driver in [o for o in bpy.data.objects if is_batch_driver(o) and o.session_uid not in batches.by_driver]:
        bpy.data.objects.remove(batch_driver)


def remove_buffers() -> None:
    """Remove all position buffers and players; `playback.resume` creates them again.

    An undo keeps datablocks in memory that are equal in two undo steps. If such a datablock points to an object that
    was created outside of an undo step, it points to freed memory after the undo.
    """
    reset_players()
    for mesh_object in [o for o in bpy.data.objects if o.type == "MESH"]:
        modifier = playback_modifier.find_modifier(mesh_object)
        if modifier is not None:
            playback_modifier.set_buffer(modifier, None)
    remove_unused_objects()


@contextmanager
def isolated_errors(mesh_object: bpy.types.Object) -> Iterator[None]:
    """Show the rig of a character if the block fails for it; the other characters continue to play."""
    try:
        yield
    except FDDAError as error:
        disable(mesh_object, error)
    except Exception as error:
        # Any exception is caught here, because an exception in a handler would stop all characters.
        message = f"The model of '{mesh_object.name}' cannot be played ({error!r}); bind it again."
        disable(mesh_object, ModelError(message))


def disable(mesh_object: bpy.types.Object, error: FDDAError) -> None:
    """Show the rig of an object whose model cannot play, and report the error."""
    uid, player = find_player(mesh_object)
    if player is not None:
        remove_player(uid)
    mesh_object.fdda.mode = "RIG"
    if mesh_object.fdda.is_playing:
        # Setting an animated mode switches no modifiers.
        modifier_switch.switch_modifiers(mesh_object, False)
    mesh_object.fdda.status = str(error)
    print(f"FDDA is switched off for '{mesh_object.name}': {error}")
