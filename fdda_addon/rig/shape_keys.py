# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads which vertices the shape keys of a mesh move and which poses drive them, and mutes their drivers."""

from collections.abc import Container, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import product

import bpy
import numpy as np

from ..core.controls import SHAPE_KEY_PATH
from ..core.mathematics.poses import CONTROL, LOCATION, ROTATION, ROTATION_VECTOR, SCALE, Channel
from ..poses.motion_range import is_moved_by_constraints
from ..scene.arrays import COORDINATE_ELEMENT, KEY_VALUE_ELEMENT, read, write
from ..scene.controls import canonical_path, owner_name
from ..scene.scene_rig import SceneRig
from .references import is_transform_channel, split_bone_path

_KINDS = {"LOC": LOCATION, "ROT": ROTATION, "SCALE": SCALE}
"""Kinds of channels by the first part of the transform type of a driver variable."""


def key_positions(shape_keys: bpy.types.Key) -> Iterator[tuple[bpy.types.ShapeKey, np.ndarray, np.ndarray]]:
    """Yield each shape key except the Basis, with its positions and those of its relative key.

    Both are (V, 3) float32, object space.
    """
    relative_positions: dict[str, np.ndarray] = {}
    for block in shape_keys.key_blocks:
        relative_key = block.relative_key
        if relative_key.name not in relative_positions:
            relative_positions[relative_key.name] = read(relative_key.data, COORDINATE_ELEMENT)
        if block != shape_keys.reference_key:
            yield block, read(block.data, COORDINATE_ELEMENT), relative_positions[relative_key.name]


def key_distances(scene_rig: SceneRig, mesh_object: bpy.types.Object) -> dict[str, np.ndarray]:
    """Return how far each shape key moves the vertices of a mesh at most, (V,) float32, by the name of its control."""
    distances, shape_keys = {}, mesh_object.data.shape_keys
    for block, positions, relative_positions in key_positions(shape_keys) if shape_keys else ():
        path = f'key_blocks["{bpy.utils.escape_identifier(block.name)}"].value'
        largest_value = max(abs(block.slider_min), abs(block.slider_max))
        name = f"{owner_name(scene_rig, shape_keys)}/{path}"
        distances[name] = np.linalg.norm(positions - relative_positions, axis=1) * largest_value
    return distances


def find_unposed_keys(scene_rig: SceneRig, channels: Iterable[Channel]) -> set[str]:
    """Find the driven shape keys that channels do not move through all variables of their drivers.

    For example, a driver reads the location of a bone, and the channels only rotate the bone.

    Args:
        channels: channels of random poses.

    Returns:
        The names of the controls that are their values.
    """
    unposed = set()
    for mesh_object in scene_rig.mesh_objects:
        if (shape_keys := mesh_object.data.shape_keys) is not None:
            owner = owner_name(scene_rig, shape_keys)
            unposed |= {f"{owner}/{path}" for path in _find_unposed_keys(scene_rig, shape_keys, channels)}
    return unposed


def _find_unposed_keys(scene_rig: SceneRig, shape_keys: bpy.types.Key, channels: Iterable[Channel]) -> set[str]:
    """Return the paths of the values of the unposed shape keys of one mesh."""
    armature_object = scene_rig.armature_object
    posed = {
        (channel.name, ROTATION if channel.kind == ROTATION_VECTOR else channel.kind, channel.axis)
        for channel in channels
    }
    bones = armature_object.pose.bones

    def moves_bone(target: bpy.types.DriverTarget, kinds: Iterable[str], axes: Iterable[int], is_local: bool) -> bool:
        bone = bones.get(target.bone_target) if target.id == armature_object else None
        if bone is None:
            return False
        names = [bone.name] if is_local else [bone.name, *(parent.name for parent in bone.parent_recursive)]
        return is_moved_by_constraints(bone) or not posed.isdisjoint(product(names, kinds, axes))

    def is_posed(variable: bpy.types.DriverVariable) -> bool:
        target = variable.targets[0]
        if variable.type == "TRANSFORMS":
            is_local = target.transform_space != "WORLD_SPACE"
            kind, _, axis = target.transform_type.partition("_")
            axes = ["XYZ".index(axis)] if is_local and axis in "XYZ" else range(3)
            # Rotations and scales of parents move a bone too.
            kinds = (LOCATION, ROTATION, SCALE) if kind == "LOC" and not is_local else (_KINDS[kind],)
            return moves_bone(target, kinds, axes, is_local)
        if variable.type != "SINGLE_PROP":
            kinds = (LOCATION, ROTATION, SCALE)
            return any(moves_bone(target, kinds, range(3), is_local=False) for target in variable.targets)
        if target.id is None:
            return False
        path = canonical_path(target.id, target.data_path)
        if target.id == shape_keys:
            return path not in curves_by_path or path in posed_keys
        bone_name, subpath = split_bone_path(target.id, path)
        if bone_name and target.id == armature_object and is_transform_channel(subpath):
            kind = subpath[1:].partition("[")[0].partition("_")[0]
            # A component of a quaternion depends on all axes.
            axes = range(3) if "euler" not in subpath and kind == ROTATION else [int(subpath[-2])]
            return not posed.isdisjoint(product([bone_name], [kind], axes))
        return (f"{owner_name(scene_rig, target.id)}/{path}", CONTROL, 0) in posed

    curves = shape_keys.animation_data.drivers if shape_keys.animation_data else ()
    paths = [(canonical_path(shape_keys, curve.data_path), curve) for curve in curves if not curve.mute]
    curves_by_path = {path: curve for path, curve in paths if SHAPE_KEY_PATH.fullmatch(path)}
    posed_keys: set[str] = set()
    # A driver may read the value of another key.
    while new_keys := {
        path
        for path, curve in curves_by_path.items()
        if path not in posed_keys and curve.driver.variables and all(map(is_posed, curve.driver.variables))
    }:
        posed_keys |= new_keys
    return curves_by_path.keys() - posed_keys


@contextmanager
def muted_key_drivers(mesh_object: bpy.types.Object, paths: Container[str] | None = None) -> Iterator[None]:
    """Mute the drivers of values of shape keys, which keep their current values; restore drivers and values afterwards.

    Args:
        paths: paths of the values; None for all.
    """
    shape_keys = mesh_object.data.shape_keys
    animation = shape_keys.animation_data if shape_keys is not None else None
    curves = [
        curve
        for curve in (animation.drivers if animation else ())
        if not curve.mute
        and SHAPE_KEY_PATH.fullmatch(path := canonical_path(shape_keys, curve.data_path))
        and (paths is None or path in paths)
    ]
    if not curves:
        yield
        return
    bpy.context.view_layer.update()
    stored_values = read(shape_keys.key_blocks, KEY_VALUE_ELEMENT)
    evaluated_keys = shape_keys.evaluated_get(bpy.context.evaluated_depsgraph_get())
    values = read(evaluated_keys.key_blocks, KEY_VALUE_ELEMENT)
    try:
        for curve in curves:
            curve.mute = True
        write(shape_keys.key_blocks, KEY_VALUE_ELEMENT, values)
        shape_keys.update_tag()
        yield
    finally:
        for curve in curves:
            curve.mute = False
        write(shape_keys.key_blocks, KEY_VALUE_ELEMENT, stored_values)
        shape_keys.update_tag()


@contextmanager
def set_keys_undriven(scene_rig: SceneRig, channels: Iterable[Channel]) -> Iterator[None]:
    """Mute the drivers of the shape keys whose values are channels of random poses."""
    names = {channel.name for channel in channels}
    with ExitStack() as stack:
        for mesh_object in scene_rig.mesh_objects:
            owner = owner_name(scene_rig, mesh_object.data.shape_keys)
            paths = {name.removeprefix(f"{owner}/") for name in names if name.startswith(f"{owner}/")}
            if paths:
                stack.enter_context(muted_key_drivers(mesh_object, paths))
        yield
