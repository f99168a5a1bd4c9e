# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads and writes the properties of a datablock that actions animate."""

from collections.abc import Iterable

import bpy

from .compatibility import animation_curves

AnimatedValues = list[tuple[bpy.types.ID, dict[str, object]]]
"""Datablocks with the values, by RNA path, of everything that their actions animate."""


def driving_actions(animation: bpy.types.AnimData) -> list[bpy.types.Action]:
    """Return the action of a datablock and those of its NLA strips."""
    strips = (strip for track in animation.nla_tracks for strip in track.strips)
    return [action for action in (animation.action, *(strip.action for strip in strips)) if action is not None]


def animated_values(owner: bpy.types.ID, actions: Iterable[bpy.types.Action]) -> dict[str, object]:
    """Read the values, by RNA path, of everything that actions animate in a datablock."""
    values = {}
    for path in {curve.data_path for action in actions for curve in animation_curves(action)}:
        try:
            values[path] = read_value(owner, path)
        except ValueError:
            # The F-curve refers to a property that does not exist, or to the slot of another datablock.
            continue
    return values


def read_value(owner: bpy.types.ID, path: str) -> object:
    """Return the number at an RNA path, or a copy of an array."""
    value = owner.path_resolve(path)
    return value[:] if hasattr(value, "__len__") else value


def set_value(owner: bpy.types.ID, path: str, value: object) -> None:
    """Set the value that `read_value` reads."""
    struct = owner.path_resolve(path, False).data
    if path.endswith('"]'):
        struct[bpy.utils.unescape_identifier(path[path.rindex('["') + 2 : -2])] = value
    else:
        setattr(struct, path.rpartition(".")[2], value)


def read_scene_values(scene: bpy.types.Scene) -> AnimatedValues:
    """Read what actions animate in the objects of a scene, their data and their shape keys, without linked ones."""
    objects = list(scene.objects)
    object_data = [scene_object.data for scene_object in objects if scene_object.data is not None]
    shape_keys = [data.shape_keys for data in object_data if getattr(data, "shape_keys", None) is not None]
    return [
        (datablock, animated_values(datablock, driving_actions(datablock.animation_data)))
        for datablock in {*objects, *object_data, *shape_keys}
        if datablock.library is None and datablock.animation_data is not None
    ]


def restore_values(scene_values: AnimatedValues) -> None:
    """Write values that have changed back to their datablocks, if these and their properties still exist."""
    for datablock, values in scene_values:
        try:
            if any([_restore_value(datablock, path, value) for path, value in values.items()]):
                datablock.update_tag()
        except ReferenceError:
            # The datablock was removed in the meantime.
            continue


def _restore_value(owner: bpy.types.ID, path: str, value: object) -> bool:
    """Write a value back, and return whether it had changed; a property that was removed is left out."""
    try:
        if read_value(owner, path) == value:
            return False
    except ValueError:
        return False
    set_value(owner, path, value)
    return True
