# SPDX-License-Identifier: GPL-3.0-or-later
"""Binds a model to a mesh object."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import bpy

from ..core.errors import ModelError, RigError
from ..rig.modifier_stack import check_stack
from ..rig.time_inputs import check_time_inputs
from ..scene.control_reader import ABSENT_INPUTS
from ..scene.scene_rig import SceneRig, armature_modifier
from ..scene.stored_paths import stored_path_for
from . import effects, model_files, playback, playback_modifier
from .opened_model import open_model
from .session import session
from .transitions import Event


def bind(
    scene_rig: SceneRig, model_path: Path, use_in_render: bool = False, packed_text: bpy.types.Text | None = None
) -> str:
    """Bind a model to a rig and play it.

    Args:
        model_path: path of the model file, in any folder. A saved .blend file stores it as a relative path.
        use_in_render: whether final renders show the model instead of the rig.
        packed_text: the text datablock that holds a packed model (`packed_model`); `model_path` is then the path that
            the model was packed from.

    Returns:
        A sentence for the user (`rig.time_inputs.check_time_inputs`); may be empty.

    Raises:
        ModelError: the file is not a model, or the model was trained for another rig. The scene is unchanged.
        RigError: the rig cannot be read, a model cannot replace its modifiers, or the object is linked.
    """
    mesh_object = scene_rig.mesh_object
    _check_editable(mesh_object)
    if mesh_object.mode == "EDIT":
        raise RigError(f"'{mesh_object.name}' is in edit mode; leave it first.")
    model_path = model_path.absolute()
    network = model_files.load_network(packed_text or model_path)
    with model_disabled(mesh_object):
        opened_model = open_model(scene_rig, network)
        stack = check_stack(mesh_object)
        note = check_time_inputs(scene_rig, opened_model.rig.controls, stack)
    if mesh_object.fdda.is_bound:
        unbind(mesh_object)

    if packed_text is None:
        model_files.allow_path(model_path)
    # Modifiers after the last deforming modifier stay on and change the positions of the model.
    playback_modifier.add_modifiers(mesh_object, stack.insert_index)
    binding = mesh_object.fdda
    binding.model = stored_path_for(mesh_object, model_path)
    binding.packed = packed_text
    if armature_modifier(mesh_object) is None:
        # What the armature is found by may be removed, as in a fast rig.
        binding.armature = scene_rig.armature_object
    binding.model_mesh = opened_model.network.info.meshes[0].name
    # Without the model, renders of a fast rig would show what is left of its modifiers.
    binding.use_in_render = use_in_render or binding.is_fast_rig
    binding.is_bound = True
    binding.mode = "FDDA"
    return note


def unbind(mesh_object: bpy.types.Object) -> None:
    """Restore the rig of a mesh object and remove everything that `bind` added.

    Raises:
        RigError: the object is linked.
    """
    binding = mesh_object.fdda
    if not binding.is_bound:
        return
    _check_editable(mesh_object)
    character = session.character_of(mesh_object)
    binding.mode = "RIG"
    session.dispatch(Event.UNBIND, character)
    playback_modifier.remove_modifiers(mesh_object)
    effects.remove_unused_objects()
    properties = ("is_bound", "model", "packed", "model_mesh", "use_in_render", "status")
    for property_name in properties if binding.is_fast_rig else (*properties, "armature"):
        binding.property_unset(property_name)


def _check_editable(mesh_object: bpy.types.Object) -> None:
    if mesh_object.library is not None:
        file_name = Path(mesh_object.library.filepath).name
        raise RigError(
            f"'{mesh_object.name}' is linked from '{file_name}' and cannot be changed here; give it a library "
            "override, or bind the model in that file."
        )


def check_plays(mesh_object: bpy.types.Object) -> None:
    """Evaluate the scene, and check that a bound object plays its model.

    Raises:
        ModelError: it does not play, or has a warning other than that a mesh with extra inputs is missing.
    """
    bpy.context.view_layer.update()
    status = mesh_object.fdda.status
    if status and ABSENT_INPUTS not in status:
        raise ModelError(status)


def on_property_update(mesh_object: bpy.types.Object) -> None:
    """Apply the changed properties of a bound object; the next evaluation shows the result."""
    if not mesh_object.fdda.is_bound:
        return
    character = session.character_of(mesh_object)
    session.dispatch(Event.CHOOSE_MODEL if session.uses_model(mesh_object) else Event.SHOW_RIG, character)
    # Scan now: a handler that sets the mode may run after ours, and a render does not evaluate a third time.
    playback.scan()
    mesh_object.update_tag()


def on_mask_update(mesh_object: bpy.types.Object) -> None:
    """Apply the changed mask of a bound object."""
    if mesh_object.fdda.is_bound:
        playback.update_mask(session.character_of(mesh_object), mesh_object)


@contextmanager
def temporary_mode(mesh_object: bpy.types.Object, mode: str) -> Iterator[None]:
    """Show an object in a mode, and restore its mode afterwards: no handler, driver, keyframe or user switches it."""
    binding, object_uid = mesh_object.fdda, mesh_object.session_uid
    previous_mode = binding.mode
    mode_stack = session.modes.setdefault(object_uid, [])
    mode_stack.append(mode)
    try:
        if binding.is_bound:
            binding.mode = mode
        yield
    finally:
        mode_stack.pop()
        if not mode_stack:
            session.modes.pop(object_uid, None)
        if binding.is_bound:
            binding.mode = previous_mode


@contextmanager
def model_disabled(*mesh_objects: bpy.types.Object) -> Iterator[None]:
    """Show the rigs of bound objects, and restore their modes afterwards."""
    with ExitStack() as stack:
        for mesh_object in mesh_objects:
            stack.enter_context(temporary_mode(mesh_object, "RIG"))
        yield


@contextmanager
def temporary_binding(scene_rig: SceneRig, model_path: Path) -> Iterator[None]:
    """Play a model, and restore the binding of the object afterwards.

    Raises:
        FDDAError: as `bind`.
    """
    binding = scene_rig.mesh_object.fdda
    previous_arguments = None
    if binding.is_bound:
        previous_path = Path(binding.model) if binding.packed else model_files.model_path(scene_rig.mesh_object)
        previous_arguments = (previous_path, binding.use_in_render, binding.packed)
    previous_mode, previous_stored_path = binding.mode, binding.model
    bind(scene_rig, model_path)
    try:
        yield
    finally:
        unbind(scene_rig.mesh_object)
        if previous_arguments is not None:
            bind(scene_rig, *previous_arguments)
            binding.model = previous_stored_path
            binding.mode = previous_mode
