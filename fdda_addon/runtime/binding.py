# SPDX-License-Identifier: GPL-3.0-or-later
"""Binds a model to a mesh object."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import bpy

from ..core.errors import RigError
from ..rig.modifier_stack import check_stack
from ..rig.time_inputs import check_time_inputs
from ..scene.scene_rig import SceneRig
from ..scene.stored_paths import stored_path_for
from . import model_files, modifier_switch, packed_model, playback, playback_modifier, position_buffer, registry
from .mode_override import override_mode
from .opened_model import open_model


def bind(
    scene_rig: SceneRig, model: Path, use_in_render: bool = False, packed_text: bpy.types.Text | None = None
) -> None:
    """Bind a model to a rig and play it.

    Args:
        scene_rig: the rig.
        model: path of the model, in any folder; a saved file stores it relative to itself.
        use_in_render: final renders use the model too.
        packed_text: the text datablock that holds the model (`packed_model`); `model` is then its original path.

    Raises:
        ModelError: the file is no model, or was trained for another rig. The scene is unchanged.
        RigError: the rig cannot be read, a model cannot replace its modifiers, or the object is linked.
    """
    mesh_object = scene_rig.mesh_object
    _check_editable(mesh_object)
    if mesh_object.mode == "EDIT":
        raise RigError(f"'{mesh_object.name}' is in edit mode; leave it first.")
    model = model.absolute()
    network = model_files.load_network(model) if packed_text is None else packed_model.load(packed_text)
    with model_disabled(mesh_object):
        opened = open_model(scene_rig, network)
        stack = check_stack(mesh_object)
        check_time_inputs(scene_rig, opened.rig.controls, stack)
    if mesh_object.fdda.is_bound:
        unbind(mesh_object)

    if packed_text is None:
        model_files.allow(model)
    # The modifiers after the last deforming one stay on and work on the model's output.
    playback_modifier.add_modifier(mesh_object, stack.insert_index)
    binding = mesh_object.fdda
    binding.model = stored_path_for(mesh_object, model)
    binding.packed = packed_text
    binding.use_in_render = use_in_render
    binding.is_bound = True
    registry.reset_players()
    binding.mode = "FDDA"


def unbind(mesh_object: bpy.types.Object) -> None:
    """Restore the rig of a mesh object and remove everything that `bind` added.

    Raises:
        RigError: the object is linked.
    """
    binding = mesh_object.fdda
    if not binding.is_bound:
        return
    _check_editable(mesh_object)
    binding.mode = "RIG"
    modifier = playback_modifier.find_modifier(mesh_object)
    if modifier is not None:
        buffer = playback_modifier.buffer_of(modifier)
        playback_modifier.set_buffer(modifier, None)
        if not playback_modifier.is_from_library(modifier):
            mesh_object.modifiers.remove(modifier)
        if buffer is not None and buffer not in playback_modifier.used_buffers():
            position_buffer.remove_buffer(buffer)
    for name in ("is_bound", "model", "packed", "use_in_render", "status"):
        binding.property_unset(name)
    registry.reset_players()


def _check_editable(mesh_object: bpy.types.Object) -> None:
    if mesh_object.library is not None:
        file_name = Path(mesh_object.library.filepath).name
        raise RigError(
            f"'{mesh_object.name}' is linked from '{file_name}' and cannot be changed here; give it a library "
            "override, or bind the model in that file."
        )


def on_property_update(mesh_object: bpy.types.Object) -> None:
    """Apply the changed properties of a bound object; the next evaluation shows them."""
    if mesh_object.fdda.is_bound:
        was_playing = mesh_object.fdda.is_playing
        modifier_switch.switch_modifiers(mesh_object)
        if mesh_object.fdda.is_playing != was_playing:
            registry.recreate_player(mesh_object)
            # At once: a handler that sets the mode may run after ours, and a render evaluates no third time.
            registry.scan()
        mesh_object.update_tag()


def on_mask_update(mesh_object: bpy.types.Object) -> None:
    """Apply the changed mask of a bound object."""
    if mesh_object.fdda.is_bound:
        playback.update_mask(mesh_object)


@contextmanager
def temporary_mode(mesh_object: bpy.types.Object, mode: str) -> Iterator[None]:
    """Show a bound object in a mode, whatever drives or keys its own, and restore its binding afterwards."""
    binding = mesh_object.fdda
    previous_mode = binding.mode
    try:
        with override_mode(mesh_object, mode):
            if binding.is_bound:
                binding.mode = mode
                modifier = playback_modifier.find_modifier(mesh_object)
                if not binding.is_playing and modifier is not None:
                    # The user may make the modifier visible meanwhile.
                    modifier_switch.disconnect(modifier)
            yield
    finally:
        if binding.is_bound:
            binding.mode = previous_mode


@contextmanager
def model_disabled(mesh_object: bpy.types.Object) -> Iterator[None]:
    """Show the rig of a bound object, and restore its binding afterwards."""
    with temporary_mode(mesh_object, "RIG"):
        yield


@contextmanager
def temporary_binding(scene_rig: SceneRig, model: Path | None) -> Iterator[None]:
    """Play a model, and restore the binding of the object afterwards.

    Args:
        scene_rig: the rig.
        model: path of the model; None to keep the bound model and show the rig.

    Raises:
        FDDAError: as `bind`.
    """
    binding = scene_rig.mesh_object.fdda
    if model is None:
        with model_disabled(scene_rig.mesh_object):
            yield
        return
    previous = None
    if binding.is_bound:
        path = Path(binding.model) if binding.packed else model_files.model_path(scene_rig.mesh_object)
        previous = (path, binding.use_in_render, binding.packed)
    mode, stored_path = binding.mode, binding.model
    bind(scene_rig, model)
    try:
        yield
    finally:
        unbind(scene_rig.mesh_object)
        if previous is not None:
            bind(scene_rig, *previous)
            binding.model = stored_path
            binding.mode = mode
