# SPDX-License-Identifier: GPL-3.0-or-later
"""What deforms a mesh beside the weights of its bones: bones and numbers that its drivers and modifiers read."""

import re
from collections.abc import Iterator
from dataclasses import dataclass

import bpy

from ..core.controls import OTHER_OBJECT, Control
from ..core.errors import RigError
from ..poses.motion_range import rotation_ranges
from ..scene.controls import make_control, owner_name
from ..scene.scene_rig import SceneRig, read_objects

_OF_BONE = re.compile(r'pose\.bones\["(?P<bone>(?:[^"\\]|\\.)*)"\]\.(?:location|rotation_\w+|scale)(?:\[\d\])?')
_CHANNELS = {
    **{f"LOC_{axis}": f"location[{place}]" for place, axis in enumerate("XYZ")},
    **{f"ROT_{axis}": f"rotation_euler[{place}]" for place, axis in enumerate("XYZ")},
    **{f"SCALE_{axis}": f"scale[{place}]" for place, axis in enumerate("XYZ")},
}


@dataclass(frozen=True)
class Dependencies:
    """What a mesh depends on.

    Attributes:
        bones: names of bones of its armature that its drivers read, or that move what its modifiers read.
        controls: numbers that its drivers read, with the ranges that their properties state.
    """

    bones: frozenset[str]
    controls: tuple[Control, ...]


def read_dependencies(scene_rig: SceneRig) -> Dependencies:
    """Find what a mesh depends on; numbers that state no range are left out, a user can list them with one."""
    bones: set[str] = set()
    controls: dict[str, Control] = {}
    objects = _objects(scene_rig)
    for scene_object in objects:
        bones |= _bones_that_move(scene_rig, scene_object)
    for control in _of_other_armatures(scene_rig):
        controls[control.name] = control
    for scene_object in objects:
        for read in _driver_targets(scene_object):
            bone, place = _meant(scene_rig, *read)
            if bone:
                bones.add(bone)
            elif place:
                try:
                    control = make_control(scene_rig, *place)
                except RigError:
                    continue
                controls[control.name] = control
    known = scene_rig.armature_object.data.bones
    return Dependencies(frozenset(bone for bone in bones if bone in known), tuple(controls.values()))


def _objects(scene_rig: SceneRig) -> list[bpy.types.Object]:
    """The mesh object, and all that its modifiers read, and what these read; no armatures."""
    found = [scene_rig.mesh_object]
    for scene_object in found:
        found += [o for o in read_objects(scene_object) if o not in found and o.type != "ARMATURE"]
    return found


def read_meshes(scene_rig: SceneRig) -> list[bpy.types.Object]:
    """The other mesh objects that deform a mesh."""
    return [found for found in _objects(scene_rig)[1:] if found.type == "MESH"]


def _bones_that_move(scene_rig: SceneRig, scene_object: bpy.types.Object) -> set[str]:
    """Bones of the armature that an object follows or is deformed by."""
    armature_object, bones = scene_rig.armature_object, scene_rig.armature_object.data.bones
    found = set()
    if scene_object.parent == armature_object and scene_object.parent_type == "BONE":
        found.add(scene_object.parent_bone)
    for constraint in scene_object.constraints:
        if getattr(constraint, "target", None) == armature_object and getattr(constraint, "subtarget", ""):
            found.add(constraint.subtarget)
        if constraint.type == "ARMATURE":
            found |= {target.subtarget for target in constraint.targets if target.target == armature_object}
    for modifier in scene_object.modifiers:
        if getattr(modifier, "object", None) != armature_object:
            continue
        if modifier.type == "ARMATURE":
            if scene_object == scene_rig.mesh_object:
                continue  # The bones that it follows are those that have weights.
            groups = {group.name for group in scene_object.vertex_groups}
            found |= {bone.name for bone in bones if bone.use_deform and (bone.name in groups or not groups)}
        elif getattr(modifier, "subtarget", ""):
            found.add(modifier.subtarget)
    return found


def _of_other_armatures(scene_rig: SceneRig) -> Iterator[Control]:
    """Rotations of the bones of other armatures that deform the mesh, in their ranges of motion; Euler angles only."""
    mesh_object = scene_rig.mesh_object
    groups = {group.name for group in mesh_object.vertex_groups}
    for modifier in mesh_object.modifiers:
        if modifier.type != "ARMATURE" or modifier.object in {None, scene_rig.armature_object}:
            continue
        for bone in modifier.object.pose.bones:
            if bone.bone.use_deform and bone.name in groups and bone.rotation_mode not in {"QUATERNION", "AXIS_ANGLE"}:
                path = f'pose.bones["{bpy.utils.escape_identifier(bone.name)}"].rotation_euler'
                for axis, stated in enumerate(rotation_ranges(bone)):
                    if stated.moves:
                        owner = f"{OTHER_OBJECT}{modifier.object.name}"
                        yield make_control(scene_rig, owner, f"{path}[{axis}]", (stated.low, stated.high))


def _driver_targets(
    scene_object: bpy.types.Object,
) -> Iterator[tuple[bpy.types.DriverVariable, bpy.types.DriverTarget]]:
    """Variables and targets of all drivers of an object, its data, its shape keys and its node groups."""
    data = scene_object.data
    groups = [m.node_group for m in scene_object.modifiers if m.type == "NODES" and m.node_group]
    for owner in (scene_object, data, getattr(data, "shape_keys", None), *groups):
        animation = getattr(owner, "animation_data", None)
        for curve in animation.drivers if animation else ():
            for variable in curve.driver.variables:
                yield from ((variable, target) for target in variable.targets)


def _meant(
    scene_rig: SceneRig, variable: bpy.types.DriverVariable, target: bpy.types.DriverTarget
) -> tuple[str, tuple[str, str] | None]:
    """A driver's target as a bone of the armature, or as owner and path of a number."""
    if target.id is None:
        return "", None
    of_armature = target.id == scene_rig.armature_object
    if variable.type == "SINGLE_PROP":
        match = _OF_BONE.fullmatch(target.data_path)
        if match and of_armature:
            return bpy.utils.unescape_identifier(match["bone"]), None
        owner = owner_name(scene_rig, target.id)
        return "", (owner, target.data_path) if owner else None
    if variable.type in {"TRANSFORMS", "ROTATION_DIFF", "LOC_DIFF"}:
        if of_armature:
            return target.bone_target, None
        owner = owner_name(scene_rig, target.id)
        path = (
            _CHANNELS.get(target.transform_type) if variable.type == "TRANSFORMS" and not target.bone_target else None
        )
        return "", (owner, path) if owner and path else None
    return "", None
