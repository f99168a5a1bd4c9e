# SPDX-License-Identifier: GPL-3.0-or-later
"""Switches a bound mesh object between the modifiers of its rig and the FDDA modifier, which shows the model."""

import bpy

from ..core.errors import ModelError
from ..rig.modifier_stack import deforming_modifiers
from ..scene.temporary_state import animated_paths
from . import playback_modifier
from .session import session


def animated_settings(mesh_object: bpy.types.Object) -> frozenset[str]:
    """Return which settings are keyed or driven: "mode", and "show_viewport" and "show_render" of the FDDA modifier."""
    all_paths = animated_paths(mesh_object)
    if not all_paths:
        return frozenset()
    modifier = playback_modifier.find_modifier(mesh_object)
    settings_by_path = {"fdda.mode": "mode"}
    if modifier is not None:
        settings_by_path |= {modifier.path_from_id(name): name for name in ("show_viewport", "show_render")}
    return frozenset(settings_by_path[path] for path in all_paths & settings_by_path.keys())


def evaluated_uses_model(evaluated: bpy.types.Object, depsgraph: bpy.types.Depsgraph, animated: frozenset[str]) -> bool:
    """Return whether the evaluated settings of a bound object show its model.

    Args:
        depsgraph: the dependency graph that evaluated the object.
        animated: the result of `animated_settings`.
    """
    visibility_setting = "show_render" if depsgraph.mode == "RENDER" else "show_viewport"
    if visibility_setting in animated:
        modifier = playback_modifier.find_modifier(evaluated)
        if modifier is not None and not getattr(modifier, visibility_setting):
            return False
    return evaluated.fdda.mode != "RIG"


def apply_visibility(mesh_object: bpy.types.Object, animated: frozenset[str]) -> None:
    """Set the mode from the visibility of the FDDA modifier, in case the user has changed it; hidden shows the rig.

    Args:
        animated: the result of `animated_settings`. Changes of these settings are not the user's.
    """
    binding, modifier = mesh_object.fdda, playback_modifier.find_modifier(mesh_object)
    if modifier is None or session.overriding_mode(mesh_object.session_uid):
        return
    if binding.is_playing and not mesh_object.add_rest_position_attribute:
        # The user may have switched off what the FDDA modifier needs.
        if binding.adds_rest_position:
            binding.adds_rest_position = False
        playback_modifier.add_rest_position(mesh_object, modifier, keep=False)
    if modifier.show_viewport != binding.is_playing:
        if "show_viewport" in animated:
            return
        if "mode" in animated:
            # Keyframes or drivers would reset the mode, so set the visibility instead.
            modifier.show_viewport = binding.is_playing
        else:
            binding.mode = "FDDA" if modifier.show_viewport else "RIG"
            if binding.mode == "RIG":
                binding.status = (
                    f"The modifier '{modifier.name}' of '{mesh_object.name}' was switched off, so the rig is shown; "
                    "switch it on, or choose another mode, to play the model."
                )
    elif binding.is_playing and modifier.show_render != binding.use_in_render and "show_render" not in animated:
        binding.use_in_render = modifier.show_render


def switch_modifiers(mesh_object: bpy.types.Object, show_model: bool) -> None:
    """Switch a bound object between the modifiers of its rig and the FDDA modifier.

    While a model plays, the modifiers of the rig are off in the viewport, and in renders if the user chose so. The
    object's properties store their visibility.

    Raises:
        ModelError: the FDDA modifier was removed.
    """
    binding, modifier = mesh_object.fdda, playback_modifier.find_modifier(mesh_object)
    if show_model and modifier is None:
        raise ModelError(f"The FDDA modifier of '{mesh_object.name}' was removed; bind the model again.")
    if show_model and not binding.is_playing:
        _store_visibility(mesh_object)
    elif not show_model and binding.is_playing:
        _restore_visibility(mesh_object)
    for added_modifier in playback_modifier.added_modifiers(mesh_object):
        added_modifier.show_viewport = show_model
        added_modifier.show_render = show_model and binding.use_in_render
    if show_model:
        binding.status = ""
        for stored, rig_modifier in _stored_modifiers(mesh_object):
            rig_modifier.show_viewport = False
            rig_modifier.show_render = stored.show_render and not binding.use_in_render


def _store_visibility(mesh_object: bpy.types.Object) -> None:
    binding = mesh_object.fdda
    binding.modifiers.clear()
    for modifier in deforming_modifiers(mesh_object):
        stored = binding.modifiers.add()
        stored.uid = modifier.persistent_uid
        stored.show_viewport, stored.show_render = modifier.show_viewport, modifier.show_render
    binding.adds_rest_position = mesh_object.add_rest_position_attribute
    binding.is_playing = True


def _restore_visibility(mesh_object: bpy.types.Object) -> None:
    for stored, modifier in _stored_modifiers(mesh_object):
        modifier.show_viewport, modifier.show_render = stored.show_viewport, stored.show_render
    mesh_object.fdda.modifiers.clear()
    mesh_object.fdda.is_playing = False
    mesh_object.add_rest_position_attribute = mesh_object.fdda.adds_rest_position
    if mesh_object.data.shape_keys is not None:
        # The player has muted the evaluated shape keys, and Blender has to copy them again.
        mesh_object.data.shape_keys.update_tag()


def _stored_modifiers(mesh_object: bpy.types.Object) -> list[tuple]:
    """Return the modifiers of the rig whose visibility is stored, as pairs of stored visibility and modifier."""
    modifiers = {modifier.persistent_uid: modifier for modifier in mesh_object.modifiers}
    return [(stored, modifiers[stored.uid]) for stored in mesh_object.fdda.modifiers if stored.uid in modifiers]
