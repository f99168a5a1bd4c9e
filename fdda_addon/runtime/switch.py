# SPDX-License-Identifier: GPL-3.0-or-later
"""Switches a bound mesh object between the modifiers of its rig and the one that plays the model."""

from collections.abc import Iterator
from contextlib import contextmanager

import bpy

from ..rig.modifier_stack import deforming_modifiers
from ..scene.borrow import animated_paths
from . import nodes

_held: dict[int, list[str]] = {}
"""The modes that objects are held to, the last one counts, by the session id of the object."""


@contextmanager
def held_mode(mesh_object: bpy.types.Object, mode: str) -> Iterator[None]:
    """Hold a bound object to a mode: no handler, driver, keyframe or user switches its modifiers meanwhile."""
    uid = mesh_object.session_uid
    _held.setdefault(uid, []).append(mode)
    try:
        yield
    finally:
        _held[uid].pop()
        if not _held[uid]:
            del _held[uid]


def held_mode_of(uid: int) -> str:
    """The mode that an object is held to, by its session id; empty when its own mode counts."""
    modes = _held.get(uid)
    return modes[-1] if modes else ""


def wants_model(mesh_object: bpy.types.Object) -> bool:
    """Whether the mode of a bound object, or the one that it is held to, asks for its model."""
    return (held_mode_of(mesh_object.session_uid) or mesh_object.fdda.mode) != "RIG"


def animated_switches(mesh_object: bpy.types.Object) -> frozenset[str]:
    """What keyframes or drivers set of "mode", and of "show_viewport" and "show_render" of the FDDA modifier."""
    paths = animated_paths(mesh_object)
    if not paths:
        return frozenset()
    modifier = nodes.find_modifier(mesh_object)
    switches = {"fdda.mode": "mode"}
    if modifier is not None:
        switches |= {modifier.path_from_id(name): name for name in ("show_viewport", "show_render")}
    return frozenset(switches[path] for path in paths & switches.keys())


def evaluated_wants_model(
    evaluated: bpy.types.Object, depsgraph: bpy.types.Depsgraph, animated: frozenset[str]
) -> bool:
    """As `wants_model`, as a dependency graph has evaluated what is animated (`animated_switches`)."""
    visibility = "show_render" if depsgraph.mode == "RENDER" else "show_viewport"
    if visibility in animated:
        modifier = nodes.find_modifier(evaluated)
        if modifier is not None and not getattr(modifier, visibility):
            return False
    return evaluated.fdda.mode != "RIG"


def follow_visibility(mesh_object: bpy.types.Object, animated: frozenset[str]) -> None:
    """Take the visibility of the FDDA modifier as what the user wants: off is the rig, on is the model.

    Args:
        mesh_object: bound.
        animated: what is not up to the user (`animated_switches`).
    """
    binding, modifier = mesh_object.fdda, nodes.find_modifier(mesh_object)
    if modifier is None or held_mode_of(mesh_object.session_uid):
        return
    if modifier.show_viewport != binding.is_playing:
        if "show_viewport" in animated:
            return
        if "mode" in animated:
            # Keys and drivers of the mode would switch it back: the modifier goes with them.
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


def disconnect_visible(mesh_object: bpy.types.Object, animated: frozenset[str]) -> None:
    """Have an FDDA modifier that is shown though no model plays change nothing: it is given no positions.

    Args:
        mesh_object: bound.
        animated: as of `animated_switches`.
    """
    if mesh_object.fdda.is_playing:
        return
    modifier = nodes.find_modifier(mesh_object)
    if modifier is not None and (modifier.show_viewport or modifier.show_render or animated - {"mode"}):
        disconnect(modifier)


def disconnect(modifier: bpy.types.NodesModifier) -> None:
    """Give an FDDA modifier no positions; whoever plays a model gives it some again."""
    if nodes.buffer_of(modifier) is not None:
        nodes.set_buffer(modifier, None)


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
        playing = wants_model(mesh_object)
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
