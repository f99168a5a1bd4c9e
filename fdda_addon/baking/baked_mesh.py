# SPDX-License-Identifier: GPL-3.0-or-later
"""A mesh object that plays positions by itself, without its rig and without the add-on, for a file to hand on."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import bpy
import numpy as np

from ..core.errors import RigError
from ..rig.modifier_stack import ModifierStack
from ..runtime.binding import unbind
from ..scene.arrays import COORDINATE, write
from ..scene.compatibility import animation_curves
from ..scene.mesh import rest_positions
from ..scene.stored_paths import stored_path
from ..scene.temporary_state import temporary_attributes

MODIFIER_NAME = "FDDA Bake"
BASIS = "Basis"


def check_local(mesh_object: bpy.types.Object) -> None:
    """Fail when the modifiers of an object cannot be replaced because it is linked.

    Raises:
        RigError: says from where.
    """
    if mesh_object.library is not None:
        raise RigError(
            f"'{mesh_object.name}' is linked from '{mesh_object.library.filepath}', so its modifiers cannot be "
            "replaced here; bake it in that file, give it a library override, or write a .pc2 file."
        )


@contextmanager
def temporary_copy(mesh_object: bpy.types.Object) -> Iterator[bpy.types.Object]:
    """A copy of a mesh object that takes its place and its name in the whole file for a while.

    Whatever is done to the copy, its mesh excepted, the object itself is as it was afterwards. A model that is bound
    to it is not bound to the copy.

    Args:
        mesh_object: a local object, not in edit mode; a model that is bound to it must not play.
    """
    name = mesh_object.name
    # Local, for of a library override no modifier could be removed.
    copy = mesh_object.copy().make_local()
    unbind(copy)
    # With a fake user the object itself would be saved too.
    with temporary_attributes(mesh_object, use_fake_user=False):
        mesh_object.user_remap(copy)
        try:
            mesh_object.name, copy.name = f"{name} rig", name
            yield copy
        finally:
            copy.user_remap(mesh_object)
            _remove(copy)
            mesh_object.name = name


def play_point_cache(mesh_object: bpy.types.Object, stack: ModifierStack, path: Path, first: int) -> None:
    """Put a Mesh Cache modifier in the place of the modifiers of the rig; those above stay.

    Args:
        mesh_object: changed.
        stack: its modifiers.
        path: of the point cache; a saved file names it relative to itself.
        first: frame of its first sample.
    """
    place = _remove_deformation(mesh_object, stack)
    modifier = mesh_object.modifiers.new(MODIFIER_NAME, "MESH_CACHE")
    # Not always the last: another may be pinned to the end.
    mesh_object.modifiers.move(mesh_object.modifiers.find(modifier.name), place)
    modifier.cache_format, modifier.filepath = "PC2", stored_path(path)
    modifier.time_mode, modifier.play_mode = "FRAME", "SCENE"
    modifier.frame_start, modifier.frame_scale = first, 1.0
    modifier.interpolation, modifier.deform_mode = "LINEAR", "OVERWRITE"
    # Blender's own axes: nothing is turned, and nothing is flipped as long as nobody says so.
    modifier.forward_axis, modifier.up_axis = "POS_Y", "POS_Z"


def play_shape_keys(mesh_object: bpy.types.Object, stack: ModifierStack, positions: np.ndarray, first: int) -> None:
    """Put absolute shape keys in the place of the modifiers of the rig, one a frame; modifiers above stay.

    Args:
        mesh_object: changed; it gets a mesh of its own.
        stack: its modifiers.
        positions: (N, V, 3) float32, mesh-object space, mesh units.
        first: frame of the first of them.
    """
    _remove_deformation(mesh_object, stack)
    rest = rest_positions(mesh_object.data)
    mesh_object.data = mesh_object.data.copy()
    mesh_object.shape_key_clear()
    mesh_object.show_only_shape_key = False
    if mesh_object.parent_type in {"ARMATURE", "LATTICE"}:
        # Such a parent deforms what has no modifier of it.
        mesh_object.parent_type = "OBJECT"
    write(mesh_object.shape_key_add(name=BASIS, from_mix=False).data, COORDINATE, rest)
    keys = mesh_object.data.shape_keys
    keys.use_relative = False
    for number, moved in enumerate(positions, 1):
        # An absolute key stands where the time is when it is added.
        keys.eval_time = number
        key = mesh_object.shape_key_add(name=f"Frame {first + number - 1}", from_mix=False)
        key.interpolation = "KEY_LINEAR"
        write(key.data, COORDINATE, np.ascontiguousarray(moved, np.float32))
        # Each frame has its keyframe: between the first and the last alone, rounding would show in long actions.
        keys.keyframe_insert("eval_time", frame=first + number - 1)
    for curve in animation_curves(keys.animation_data.action):
        for point in curve.keyframe_points:
            point.interpolation = "LINEAR"


def _remove(mesh_object: bpy.types.Object) -> None:
    """Delete an object with what nothing else uses of it: its mesh, and the action of its shape keys."""
    mesh = mesh_object.data
    animation = mesh.shape_keys.animation_data if mesh.shape_keys else None
    action = animation.action if animation else None
    bpy.data.objects.remove(mesh_object)
    if mesh.users == 0:
        bpy.data.meshes.remove(mesh)
        if action is not None and action.users == 0:
            bpy.data.actions.remove(action)


def _remove_deformation(mesh_object: bpy.types.Object, stack: ModifierStack) -> int:
    """Remove the modifiers of the rig; returns the place where they were."""
    for name in stack.replaced:
        mesh_object.modifiers.remove(mesh_object.modifiers[name])
    return stack.insert_index - len(stack.replaced)
