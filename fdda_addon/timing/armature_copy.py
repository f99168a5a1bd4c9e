# SPDX-License-Identifier: GPL-3.0-or-later
"""Copies an armature into a scene of its own, so that constraints and drivers can be removed from the copy."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import bpy

COPY_NAME = "FDDA Profile"
"""Name of the temporary scenes and of the copies in them."""

RemovablePart = bpy.types.Constraint | bpy.types.FCurve


@contextmanager
def armature_copy(
    armature_object: bpy.types.Object, removed: Iterable[RemovablePart] = ()
) -> Iterator[bpy.types.Scene]:
    """Create a scene with a copy of an armature object alone, and what its bones depend on; remove both afterwards.

    The copy depends on itself where the original depends on itself, and plays the same action.

    Args:
        removed: constraints of its bones, and drivers of it and of its armature, that the copy lacks.
    """
    constraint_names: dict[str, set[str]] = {}
    driver_keys: set[tuple[bpy.types.ID, str, int]] = set()
    for part in removed:
        if isinstance(part, bpy.types.FCurve):
            driver_keys.add((part.id_data, part.data_path, part.array_index))
        else:
            bone_name = part.path_from_id().partition(".constraints[")[0]
            constraint_names.setdefault(bone_name, set()).add(part.name)
    scene = bpy.data.scenes.new(COPY_NAME)
    copies: list[bpy.types.ID] = []
    try:
        copy = _local_copy(armature_object, copies)
        copy.data = _local_copy(armature_object.data, copies)
        copy.hide_viewport = False
        for original, copied in ((armature_object, copy), (armature_object.data, copy.data)):
            drivers = copied.animation_data.drivers if copied.animation_data else ()
            for curve in list(drivers):
                if (original, curve.data_path, curve.array_index) in driver_keys:
                    drivers.remove(curve)
        for bone_path, names in constraint_names.items():
            constraints = copy.path_resolve(bone_path).constraints
            for name in names:
                constraints.remove(constraints[name])
        _point_to_copies(copy, {armature_object: copy, armature_object.data: copy.data})
        scene.collection.objects.link(copy)
        yield scene
    finally:
        bpy.data.scenes.remove(scene)
        bpy.data.batch_remove(copies)


def _local_copy(datablock: bpy.types.ID, copies: list[bpy.types.ID]) -> bpy.types.ID:
    """Copy a datablock, which may be linked or a library override, and append the copy to `copies`."""
    copy = datablock.copy()
    copies.append(copy)
    copy.name = COPY_NAME
    if copy.override_library is not None:
        copy.make_local(clear_liboverride=True)
    return copy


def _point_to_copies(copy: bpy.types.Object, copies: dict[bpy.types.ID, bpy.types.ID]) -> None:
    """Replace the originals by the copies in all constraints and drivers of the copies."""
    for bone in copy.pose.bones:
        for constraint in bone.constraints:
            for struct in (constraint, *getattr(constraint, "targets", ())):
                for name in ("target", "pole_target", "space_object"):
                    value = getattr(struct, name, None)
                    if value in copies:
                        setattr(struct, name, copies[value])
    for owner in copies.values():
        for curve in owner.animation_data.drivers if owner.animation_data else ():
            for variable in curve.driver.variables:
                for target in variable.targets:
                    if target.id in copies:
                        target.id = copies[target.id]
