# SPDX-License-Identifier: GPL-3.0-or-later
"""Switches a bound mesh object between the modifiers of its rig and the one that plays the model."""

import bpy

from ..rig.modifier_stack import deforming_modifiers
from . import nodes


def switch_modifiers(mesh_object: bpy.types.Object, playing: bool | None = None) -> None:
    """Bring the modifiers of a bound object in line with its mode, or let its model play or not, whatever the mode.

    While a model plays, the modifiers of the rig are off in the viewport, and in renders when the user asked for it;
    how they were is kept in the object's properties and comes back with mode RIG.
    """
    binding = mesh_object.fdda
    modifier = nodes.find_modifier(mesh_object)
    if binding.mode != "RIG" and modifier is None:
        binding.status = "The FDDA modifier was removed; bind the model again."
        binding.mode = "RIG"
        return
    if playing is None:
        playing = binding.mode != "RIG"
    if playing and not binding.is_playing:
        _store(mesh_object)
    elif not playing and binding.is_playing:
        _restore(mesh_object)
    if modifier is not None:
        modifier.show_viewport = playing
        modifier.show_render = playing and binding.use_in_render
    if playing:
        binding.status = ""
        for saved, rig_modifier in _saved_modifiers(mesh_object):
            rig_modifier.show_viewport = False
            rig_modifier.show_render = saved.show_render and not binding.use_in_render


def give_back(mesh_object: bpy.types.Object) -> None:
    """Show the modifiers of the rig as if no model played; the mode stays, and `switch_modifiers` follows it again."""
    if mesh_object.fdda.is_playing:
        _restore(mesh_object)
    modifier = nodes.find_modifier(mesh_object)
    if modifier is not None:
        modifier.show_viewport = modifier.show_render = False


def unpin_shape_keys(mesh_object: bpy.types.Object) -> None:
    """Show the shape keys that an older version of the add-on hid while it played, in a file that was saved so."""
    binding = mesh_object.fdda
    if binding.is_property_set("active_shape_key_index"):
        if binding.is_playing and mesh_object.data.shape_keys is not None:
            mesh_object.show_only_shape_key = binding.show_only_shape_key
            mesh_object.active_shape_key_index = binding.active_shape_key_index
        for name in ("active_shape_key_index", "show_only_shape_key"):
            binding.property_unset(name)


def _store(mesh_object: bpy.types.Object) -> None:
    binding = mesh_object.fdda
    binding.modifiers.clear()
    for modifier in deforming_modifiers(mesh_object):
        saved = binding.modifiers.add()
        saved.uid = modifier.persistent_uid
        saved.show_viewport, saved.show_render = modifier.show_viewport, modifier.show_render
    binding.is_playing = True


def _restore(mesh_object: bpy.types.Object) -> None:
    for saved, modifier in _saved_modifiers(mesh_object):
        modifier.show_viewport, modifier.show_render = saved.show_viewport, saved.show_render
    mesh_object.fdda.modifiers.clear()
    mesh_object.fdda.is_playing = False
    if mesh_object.data.shape_keys is not None:
        # The playback has muted the evaluated ones.
        mesh_object.data.shape_keys.update_tag()


def _saved_modifiers(mesh_object: bpy.types.Object) -> list[tuple]:
    by_uid = {modifier.persistent_uid: modifier for modifier in mesh_object.modifiers}
    return [(saved, by_uid[saved.uid]) for saved in mesh_object.fdda.modifiers if saved.uid in by_uid]
