# SPDX-License-Identifier: GPL-3.0-or-later
"""Playback: runs models during Blender's evaluation, and keeps the players up to date after it.

`on_evaluate` runs on the thread that evaluates and only writes to evaluated data. Original data are changed after the
evaluation (`on_depsgraph_update`, `on_frame_change`).
"""

from collections.abc import Container, Iterator
from contextlib import contextmanager

import bpy

from . import modifier_switch, playback_modifier, registry, rig_signature
from .depsgraph_changes import DepsgraphChanges, changed_meshes, has_edited_armature
from .mode_override import overriding_mode
from .model_files import network_of
from .player import VIEWPORT_KEY, Player

_is_switching = False
"""Whether `_apply_animated_mode` is evaluating the dependency graph."""


def on_evaluate(driven_object: bpy.types.Object) -> None:
    """Play the models of an evaluated position buffer or batch driver. Raises nothing."""
    driven_uid = driven_object.original.session_uid
    player_or_batch = registry.players.get(driven_uid) or registry.batches.by_driver.get(driven_uid)
    if player_or_batch is not None:
        player_or_batch.play(driven_object)


def on_frame_change(depsgraph: bpy.types.Depsgraph) -> None:
    """Keep the players up to date after a frame was evaluated.

    If only poses and shape keys have changed, nothing is checked.
    """
    updated = depsgraph.id_type_updated
    if (
        updated("SCENE")
        or (updated("ARMATURE") and has_edited_armature(depsgraph))
        or (updated("MESH") and changed_meshes(depsgraph))
    ):
        _check_changes(depsgraph)
    _update_players(depsgraph)
    registry.update_batches(frame_changed=True)


def on_depsgraph_update(depsgraph: bpy.types.Depsgraph) -> None:
    """Keep the players up to date after an evaluation without a frame change."""
    _check_changes(depsgraph)
    _update_players(depsgraph)
    registry.update_batches(frame_changed=False)


def _update_players(depsgraph: bpy.types.Depsgraph) -> None:
    """Create missing players, remove outdated ones, report warnings, and show the rig where playback failed."""
    for uid, player in list(registry.players.items()):
        if player.needs_recreation:
            registry.remove_player(uid)
    registry.scan()
    _tag_new_depsgraph(depsgraph)
    _record_viewport_copies(depsgraph)
    for player in list(registry.players.values()):
        mesh_object = player.find_object() if player.error or player.has_new_warning else None
        if mesh_object is None:
            continue
        with registry.isolated_errors(mesh_object):
            if player.error:
                raise player.error
            mesh_object.fdda.status = player.pop_warning()
    if any(registry.animated_settings.values()) and not _is_switching:
        for mesh_object in [o for o in bpy.data.objects if registry.animated_settings.get(o.session_uid)]:
            with registry.isolated_errors(mesh_object):
                _apply_animated_mode(mesh_object, depsgraph)


def _tag_new_depsgraph(depsgraph: bpy.types.Depsgraph) -> None:
    """Tag the position buffers of new players, so that a dependency graph evaluates them once more.

    The first evaluation of a graph leaves out the objects that it did not need while the modifier was off.
    """
    # A graph has no id, and Blender reuses the address of a graph for another one.
    depsgraph_key = depsgraph.mode, depsgraph.scene.session_uid, depsgraph.view_layer.name
    new_uids = {uid for uid, player in registry.players.items() if depsgraph_key not in player.depsgraph_keys}
    if new_uids:
        for buffer in [o for o in bpy.data.objects if o.session_uid in new_uids]:
            registry.players[buffer.session_uid].depsgraph_keys.add(depsgraph_key)
            buffer.data.update_tag()


def _record_viewport_copies(depsgraph: bpy.types.Depsgraph) -> None:
    """Mark the evaluated objects of a viewport for players with shape keys, because a getter cannot find its graph."""
    if depsgraph.mode != "VIEWPORT":
        return
    for player in [player for player in registry.players.values() if player.needs_viewport_record]:
        mesh_object = player.find_object()
        if mesh_object is not None and (evaluated := mesh_object.evaluated_get(depsgraph)).is_evaluated:
            evaluated[VIEWPORT_KEY], player.needs_viewport_record = True, False


def _apply_animated_mode(mesh_object: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> None:
    """Switch the modifiers of an object whose animated or driven mode now differs from what it shows."""
    global _is_switching
    evaluated, binding = mesh_object.evaluated_get(depsgraph), mesh_object.fdda
    animated = registry.animated_settings[mesh_object.session_uid]
    modifier_switch.disconnect_visible(mesh_object, animated)
    if not evaluated.is_evaluated or (depsgraph.mode == "RENDER" and not binding.use_in_render):
        return
    if overriding_mode(mesh_object.session_uid):
        return
    uses_model = modifier_switch.evaluated_uses_model(evaluated, depsgraph, animated)
    # A model that cannot play stays off until the user acts: the status says how.
    if uses_model != binding.is_playing and not (uses_model and binding.status):
        modifier_switch.switch_modifiers(mesh_object, uses_model)
        binding.status = ""
        registry.recreate_player(mesh_object)
        # The first evaluation only finds that the position buffer is needed; the next one evaluates it.
        _is_switching = True
        try:
            depsgraph.update()
        finally:
            _is_switching = False
        registry.recreate_player(mesh_object)
        registry.scan()


def _check_changes(depsgraph: bpy.types.Depsgraph) -> None:
    """Check the bound objects and the rigs that an evaluation has changed."""
    changes = DepsgraphChanges.read(depsgraph)
    for mesh_object, geometry_changed, changed_beyond_pose in changes.mesh_objects:
        if mesh_object.fdda.is_bound:
            with registry.isolated_errors(mesh_object):
                _check_object(mesh_object, geometry_changed, changed_beyond_pose)
    _update_masks(changes.meshes)
    # The graph of a render reports all datablocks as changed.
    if depsgraph.mode != "RENDER":
        _check_rigs(changes)


def _check_object(mesh_object: bpy.types.Object, geometry_changed: bool, changed_beyond_pose: bool) -> None:
    """Check a bound object that an evaluation has changed (`DepsgraphChanges.mesh_objects`)."""
    update_mask(mesh_object)
    if mesh_object.session_uid not in registry.animated_settings:
        registry.request_rescan()
        return
    animated = registry.animated_settings[mesh_object.session_uid] = modifier_switch.animated_settings(mesh_object)
    if geometry_changed:
        modifier_switch.apply_visibility(mesh_object, animated)
        modifier_switch.disconnect_visible(mesh_object, animated)
    uid, player = registry.find_player(mesh_object)
    if player is None:
        return
    if (geometry_changed and not (player.fits_object(mesh_object) and _modifier_reads_buffer(mesh_object, uid))) or (
        changed_beyond_pose and not player.has_same_skin(mesh_object)
    ):
        registry.remove_player(uid)
    elif mesh_object.mode not in rig_signature.STABLE_MODES:
        registry.edited_objects.add(mesh_object.session_uid)


def _check_rigs(changes: DepsgraphChanges) -> None:
    """Check the rigs whose armature or mesh has changed, and the rigs whose mesh has left an edit mode."""
    for mesh_uid, changed_beyond_positions in changes.meshes.items():
        if changed_beyond_positions:
            rig_signature.invalidate(mesh_uid)
    edited_uids = registry.edited_objects
    for uid, player in list(registry.players.items()):
        parents_changed = changes.armatures.get(player.signature.armature_uid)
        changed_beyond_positions = changes.meshes.get(player.signature.mesh_uid)
        is_edited = player.object_uid in edited_uids
        if parents_changed is None and changed_beyond_positions is None and not is_edited:
            continue
        mesh_object = player.find_object()
        if mesh_object is None:
            continue
        with registry.isolated_errors(mesh_object):
            if parents_changed is not None and not player.has_same_bones(mesh_object, compare_parents=parents_changed):
                registry.remove_player(uid)
            elif mesh_object.mode not in rig_signature.STABLE_MODES:
                edited_uids.add(player.object_uid)
            elif (
                changed_beyond_positions
                or is_edited
                or (changed_beyond_positions is False and not player.has_same_rest_positions(mesh_object))
            ):
                if is_edited:
                    edited_uids.discard(player.object_uid)
                    rig_signature.invalidate(player.signature.mesh_uid)
                player.signature = rig_signature.RigSignature.read(player.scene_rig(mesh_object))
                player.check_rig(mesh_object)


def update_mask(mesh_object: bpy.types.Object, *, weights_changed: bool = False) -> None:
    """Play the pose of a bound object again if its mask has changed."""
    buffer_uid, player = registry.find_player(mesh_object)
    if player is not None and player.update_mask(mesh_object, weights_changed):
        for buffer in [o for o in bpy.data.objects if o.session_uid == buffer_uid]:
            buffer.data.update_tag()


def _update_masks(mesh_uids: Container[int]) -> None:
    """Read the masks of the meshes with these session ids again, because their weights may have been painted."""
    for player in [p for p in registry.players.values() if p.has_mask and p.signature.mesh_uid in mesh_uids]:
        mesh_object = player.find_object()
        if mesh_object is not None:
            with registry.isolated_errors(mesh_object):
                update_mask(mesh_object, weights_changed=True)


def _modifier_reads_buffer(mesh_object: bpy.types.Object, buffer_uid: int) -> bool:
    """Return whether the modifier of a mesh object reads a position buffer."""
    modifier = playback_modifier.find_modifier(mesh_object)
    buffer = modifier and playback_modifier.buffer_of(modifier)
    return buffer is not None and buffer.session_uid == buffer_uid


def has_outdated_model(mesh_object: bpy.types.Object) -> bool:
    """Return whether an object plays a model whose file has been replaced since it was loaded."""
    player = registry.find_player(mesh_object)[1]
    return player is not None and player.network is not network_of(mesh_object)


def playing_objects() -> list[bpy.types.Object]:
    """Return the objects of the open file that a model deforms."""
    return [o for o in bpy.data.objects if o.type == "MESH" and o.fdda.is_playing]


def restore_rigs() -> None:
    """Show all rigs of the open file as if no model played; `resume` starts playback again."""
    for mesh_object in playing_objects():
        # Linked objects are restored too, because Blender saves the differences of a library override from them.
        modifier_switch.restore_rig(mesh_object)


def resume() -> None:
    """Create all players of the open file again, and play its models."""
    registry.reset_players()
    registry.scan()


@contextmanager
def suspended_playback() -> Iterator[None]:
    """Show the rigs of the open file and remove our data in the block, so that parts of the file can be written."""
    restore_rigs()
    registry.remove_buffers()
    try:
        with registry.suspended_scans():
            yield
    finally:
        resume()


@contextmanager
def without_model_runs() -> Iterator[None]:
    """Play without running models in the block, to measure the rest of a frame: the last positions are kept."""
    Player.skips_models = True
    try:
        yield
    finally:
        Player.skips_models = False
