# SPDX-License-Identifier: GPL-3.0-or-later
"""Ties a model to a mesh object."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import bpy

from ..core.errors import RigError
from ..rig.modifier_stack import check_stack
from ..rig.time_inputs import check_inputs
from ..scene.scene_rig import SceneRig
from ..scene.stored_paths import path_for
from . import model_files, nodes, packed, playback, position_buffer, switch
from .opened_model import open_model


def bind(
    scene_rig: SceneRig, model: Path, use_in_render: bool = False, packed_model: bpy.types.Text | None = None
) -> None:
    """Bind a model to a rig and play it.

    Args:
        scene_rig: the rig.
        model: the model, anywhere; a saved file remembers it relative to itself.
        use_in_render: let final renders use the model too.
        packed_model: the text that holds the model (`packed`); `model` is then where it came from.

    Raises:
        ModelError: the file is no model, or was trained for another rig. The scene is as before.
        RigError: the rig cannot be read, no model can stand in for its modifiers, or the object is linked.
    """
    mesh_object = scene_rig.mesh_object
    _check_editable(mesh_object)
    if mesh_object.mode == "EDIT":
        raise RigError(f"'{mesh_object.name}' is in edit mode; leave it first.")
    model = model.absolute()
    network = model_files.load_network(model) if packed_model is None else packed.load(packed_model)
    with true_rig(mesh_object):
        opened = open_model(scene_rig, network)
        stack = check_stack(mesh_object)
        check_inputs(scene_rig, opened.rig.controls, stack)
    if mesh_object.fdda.is_bound:
        unbind(mesh_object)

    if packed_model is None:
        model_files.choose(model)
    # Those after the last deforming one stay and work on what the model gives.
    nodes.add_modifier(mesh_object, stack.place)
    binding = mesh_object.fdda
    binding.model = path_for(mesh_object, model)
    binding.packed = packed_model
    binding.use_in_render = use_in_render
    binding.is_bound = True
    playback.forget()
    binding.mode = "FDDA"


def unbind(mesh_object: bpy.types.Object) -> None:
    """Give the mesh back to its rig and remove everything that `bind` added.

    Raises:
        RigError: the object is linked.
    """
    binding = mesh_object.fdda
    if not binding.is_bound:
        return
    _check_editable(mesh_object)
    binding.mode = "RIG"
    modifier = nodes.find_modifier(mesh_object)
    if modifier is not None:
        buffer = nodes.buffer_of(modifier)
        nodes.set_buffer(modifier, None)
        if not nodes.is_inherited(modifier):
            mesh_object.modifiers.remove(modifier)
        if buffer is not None and buffer not in nodes.used_buffers():
            position_buffer.remove_buffer(buffer)
    for name in ("is_bound", "model", "packed", "use_in_render", "status"):
        binding.property_unset(name)
    playback.forget()


def _check_editable(mesh_object: bpy.types.Object) -> None:
    if mesh_object.library is not None:
        file = Path(mesh_object.library.filepath).name
        raise RigError(
            f"'{mesh_object.name}' is linked from '{file}' and cannot be changed here; give it a library override, or "
            "bind the model in that file."
        )


def apply(mesh_object: bpy.types.Object) -> None:
    """Bring a bound object in line with its properties; the next evaluation shows it."""
    if mesh_object.fdda.is_bound:
        was_playing = mesh_object.fdda.is_playing
        switch.switch_modifiers(mesh_object)
        if mesh_object.fdda.is_playing != was_playing:
            playback.make_anew(mesh_object)
            # At once: a handler that sets the mode may run after ours, and a render evaluates no third time.
            playback.scan()
        mesh_object.update_tag()


def apply_mask(mesh_object: bpy.types.Object) -> None:
    """Show a bound object with the mask that its properties name now."""
    if mesh_object.fdda.is_bound:
        playback.follow_mask(mesh_object)


@contextmanager
def borrowed_mode(mesh_object: bpy.types.Object, mode: str) -> Iterator[None]:
    """Show a bound object in a mode, whatever drives or keys its own; the binding is as before afterwards."""
    binding = mesh_object.fdda
    previous = binding.mode
    try:
        with switch.held_mode(mesh_object, mode):
            if binding.is_bound:
                binding.mode = mode
                modifier = nodes.find_modifier(mesh_object)
                if not binding.is_playing and modifier is not None:
                    # Also where somebody shows it meanwhile.
                    switch.disconnect(modifier)
            yield
    finally:
        if binding.is_bound:
            binding.mode = previous


@contextmanager
def true_rig(mesh_object: bpy.types.Object) -> Iterator[None]:
    """Borrow a bound object for its rig: the rig deforms it inside, the binding is as before afterwards."""
    with borrowed_mode(mesh_object, "RIG"):
        yield


@contextmanager
def borrowed_binding(scene_rig: SceneRig, model: Path | None) -> Iterator[None]:
    """Play a model for a while; the binding that the object has, or none, is there again afterwards.

    Args:
        scene_rig: the rig.
        model: the model, None for the one that is bound.

    Raises:
        FDDAError: as `bind`.
    """
    binding = scene_rig.mesh_object.fdda
    if model is None:
        with true_rig(scene_rig.mesh_object):
            yield
        return
    previous = None
    if binding.is_bound:
        path = Path(binding.model) if binding.packed else model_files.model_path(scene_rig.mesh_object)
        previous = (path, binding.use_in_render, binding.packed)
    mode, stored = binding.mode, binding.model
    bind(scene_rig, model)
    try:
        yield
    finally:
        unbind(scene_rig.mesh_object)
        if previous is not None:
            bind(scene_rig, *previous)
            binding.model = stored
            binding.mode = mode
