# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes a mesh object play baked positions, without its rig and without the add-on."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import bpy
import numpy as np

from ..core.errors import RigError
from ..rig.modifier_stack import ModifierStack
from ..runtime.binding import unbind
from ..scene.arrays import COORDINATE_ELEMENT, write
from ..scene.compatibility import animation_curves
from ..scene.mesh import rest_positions
from ..scene.stored_paths import stored_path
from ..scene.temporary_state import temporary_attributes
from ..scene.time_stretching import time_ratio

BAKE_MODIFIER_NAME = "FDDA Bake"
"""Name of the Mesh Cache modifier of a baked mesh."""
BASIS_KEY_NAME = "Basis"
"""Name of the shape key with the rest positions."""


def check_local(mesh_object: bpy.types.Object) -> None:
    """Check that the modifiers of an object can be replaced.

    Raises:
        RigError: the object is linked.
    """
    if mesh_object.library is not None:
        raise RigError(
            f"'{mesh_object.name}' is linked from '{mesh_object.library.filepath}', so its modifiers cannot be "
            "replaced here; bake it in that file, give it a library override, or write a .pc2 file."
        )


@contextmanager
def temporary_copy(mesh_object: bpy.types.Object) -> Iterator[bpy.types.Object]:
    """Replace a mesh object in the file by an unbound copy with the same name; restore the object afterwards.

    Changes of the copy do not affect the object, but both share one mesh.

    Args:
        mesh_object: a local object, not in edit mode, whose model does not play.

    Yields:
        The copy.
    """
    name = mesh_object.name
    # Local, because modifiers of a library override cannot be removed.
    object_copy = mesh_object.copy().make_local()
    unbind(object_copy)
    object_copy.fdda.models.clear()
    # Blender forgets the active object if it is replaced while the view layer is outdated.
    bpy.context.view_layer.update()
    # With a fake user the original object would be saved too.
    with temporary_attributes(mesh_object, use_fake_user=False), _packed_models_unused(mesh_object):
        mesh_object.user_remap(object_copy)
        try:
            mesh_object.name, object_copy.name = f"{name} rig", name
            yield object_copy
        finally:
            object_copy.user_remap(mesh_object)
            # Remove also its mesh and the action of its shape keys if nothing else uses them.
            mesh = object_copy.data
            animation = mesh.shape_keys.animation_data if mesh.shape_keys else None
            action = animation.action if animation else None
            bpy.data.objects.remove(object_copy)
            if mesh.users == 0:
                bpy.data.meshes.remove(mesh)
                if action is not None and action.users == 0:
                    bpy.data.actions.remove(action)
            mesh_object.name = name


@contextmanager
def _packed_models_unused(mesh_object: bpy.types.Object) -> Iterator[None]:
    """Remove the pointers of an object to packed models in the block, so that a saved file does not contain them."""
    binding = mesh_object.fdda
    with ExitStack() as exit_stack:
        for owner in (binding, *binding.models):
            exit_stack.enter_context(temporary_attributes(owner, packed=None))
        yield


def play_point_cache(mesh_object: bpy.types.Object, stack: ModifierStack, path: Path, first_frame: int) -> None:
    """Replace the modifiers of the rig by a Mesh Cache modifier; the modifiers after the rig stay.

    Args:
        mesh_object: the object to change.
        stack: the modifier stack of the object.
        path: path of the point cache. A saved .blend file stores it as a relative path.
        first_frame: frame of the first sample.
    """
    index = _remove_deformation(mesh_object, stack)
    modifier = mesh_object.modifiers.new(BAKE_MODIFIER_NAME, "MESH_CACHE")
    # A new modifier is not the last one if another modifier is pinned to the end of the stack.
    mesh_object.modifiers.move(mesh_object.modifiers.find(modifier.name), index)
    modifier.cache_format, modifier.filepath = "PC2", stored_path(path)
    modifier.time_mode, modifier.play_mode = "FRAME", "SCENE"
    modifier.frame_start, modifier.frame_scale = first_frame, 1 / time_ratio()
    modifier.interpolation, modifier.deform_mode = "LINEAR", "OVERWRITE"
    # The point cache uses Blender's axes, so they must not be converted.
    modifier.forward_axis, modifier.up_axis = "POS_Y", "POS_Z"


def play_shape_keys(
    mesh_object: bpy.types.Object, stack: ModifierStack, positions: np.ndarray, first_frame: int
) -> None:
    """Replace the modifiers of the rig by absolute shape keys, one for each frame; the modifiers after the rig stay.

    Args:
        mesh_object: the object to change; it gets a copy of its mesh.
        stack: the modifier stack of the object.
        positions: (N, V, 3) float32, positions in N frames, mesh-object space, mesh units.
        first_frame: the first of these frames.
    """
    _remove_deformation(mesh_object, stack)
    basis_positions = rest_positions(mesh_object.data)
    mesh_object.data = mesh_object.data.copy()
    mesh_object.shape_key_clear()
    mesh_object.show_only_shape_key = False
    if mesh_object.parent_type in {"ARMATURE", "LATTICE"}:
        # Such a parent deforms an object that has no modifier for the parent.
        mesh_object.parent_type = "OBJECT"
    write(mesh_object.shape_key_add(name=BASIS_KEY_NAME, from_mix=False).data, COORDINATE_ELEMENT, basis_positions)
    shape_keys = mesh_object.data.shape_keys
    shape_keys.use_relative = False
    for eval_time, frame_positions in enumerate(positions, 1):
        # Blender gives a new absolute key the current evaluation time.
        shape_keys.eval_time = eval_time
        key = mesh_object.shape_key_add(name=f"Frame {first_frame + eval_time - 1}", from_mix=False)
        key.interpolation = "KEY_LINEAR"
        write(key.data, COORDINATE_ELEMENT, np.ascontiguousarray(frame_positions, np.float32))
    shape_keys.keyframe_insert("eval_time")
    (curve,) = animation_curves(shape_keys.animation_data.action)
    # With keyframes in the first and last frame alone, rounding errors would show in long actions.
    curve.keyframe_points.add(len(positions) - 1)
    for index, point in enumerate(curve.keyframe_points):
        point.co, point.interpolation = ((first_frame + index) * time_ratio(), index + 1), "LINEAR"
    curve.update()


def _remove_deformation(mesh_object: bpy.types.Object, stack: ModifierStack) -> int:
    """Remove the modifiers of the rig, and return the index of the first modifier after them."""
    for name in stack.replaced:
        mesh_object.modifiers.remove(mesh_object.modifiers[name])
    return stack.insert_index - len(stack.replaced)
