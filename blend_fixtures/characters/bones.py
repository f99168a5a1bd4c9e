# SPDX-License-Identifier: GPL-3.0-or-later
"""Add bones to the armatures of characters, limit their motion, and build a limb with a chain of bones."""

from dataclasses import dataclass
from math import radians

import bpy
import numpy as np

from blend_fixtures.elbow import END, START, elbow_surface
from fdda_addon.poses.motion_range import set_constraint_limit

from .base import link

Point = tuple[float, float, float]
LOCK_PROPERTIES = {"LIMIT_ROTATION": "lock_rotation", "LIMIT_LOCATION": "lock_location", "LIMIT_SCALE": "lock_scale"}


@dataclass(frozen=True)
class NewBone:
    """A bone to add; head and tail are in armature space, meters."""

    name: str
    head: Point
    tail: Point
    parent: str = ""
    is_deforming: bool = True
    is_connected: bool = False


def add_bones(armature_object: bpy.types.Object, *new_bones: NewBone) -> None:
    """Add bones with Euler rotation and locked transforms; `limit` unlocks axes. Parents come before their children."""
    bpy.context.view_layer.objects.active = armature_object
    bpy.ops.object.mode_set(mode="EDIT")
    try:
        bones = armature_object.data.edit_bones
        for new_bone in new_bones:
            bone = bones.new(new_bone.name)
            bone.head, bone.tail, bone.use_deform = new_bone.head, new_bone.tail, new_bone.is_deforming
            bone.align_roll((0.0, -1.0, 0.0))
            bone.parent, bone.use_connect = bones.get(new_bone.parent), new_bone.is_connected
    finally:
        bpy.ops.object.mode_set(mode="OBJECT")
    for new_bone in new_bones:
        bone = armature_object.pose.bones[new_bone.name]
        bone.rotation_mode = "XYZ"
        bone.lock_location = bone.lock_rotation = bone.lock_scale = (True, True, True)


def limit(bone: bpy.types.PoseBone, kind: str, ranges: dict[int, tuple[float, float]]) -> None:
    """Limit the motion of a bone to ranges on some axes of local space, and lock the other axes.

    Args:
        bone: the pose bone.
        kind: type of the constraint, a key of `LOCK_PROPERTIES`.
        ranges: lower and upper limit by index of the axis; degrees, meters or scale factors.
    """
    constraint = bone.constraints.new(kind)
    constraint.owner_space = "LOCAL"
    for axis, bounds in ranges.items():
        low, high = map(radians, bounds) if kind == "LIMIT_ROTATION" else bounds
        set_constraint_limit(constraint, axis, low, high)
    setattr(bone, LOCK_PROPERTIES[kind], [axis not in ranges for axis in range(3)])


def remove_constraints(bone: bpy.types.PoseBone) -> None:
    """Remove the constraints of a bone."""
    for constraint in list(bone.constraints):
        bone.constraints.remove(constraint)


def add_bone_collection(armature_object: bpy.types.Object, name: str, *bone_names: str) -> None:
    """Add a bone collection with the given bones."""
    collection = armature_object.data.collections.new(name)
    for bone_name in bone_names:
        collection.assign(armature_object.data.bones[bone_name])


def limb(count: int, degrees: float = 30.0, twist: float = 0.0) -> tuple[bpy.types.Object, bpy.types.Object]:
    """Build a tube without weights along a chain of bones named `bone.0`, `bone.1` and so on.

    Args:
        count: number of bones.
        degrees: limit of each bone's rotation about its x and z axes.
        twist: limit of each bone's rotation about its y axis, degrees.

    Returns:
        The mesh object `limb` and the armature object `limb_rig`.
    """
    armature_object = link(bpy.data.objects.new("limb_rig", bpy.data.armatures.new("limb_rig")))
    ends = np.linspace(START, END, count + 1).tolist()
    add_bones(
        armature_object,
        *(
            NewBone(f"bone.{n}", (ends[n], 0.0, 0.0), (ends[n + 1], 0.0, 0.0), f"bone.{n - 1}", is_connected=n > 0)
            for n in range(count)
        ),
    )
    for bone in armature_object.pose.bones:
        ranges = {
            axis: (-limit_degrees, limit_degrees)
            for axis, limit_degrees in enumerate((degrees, twist, degrees))
            if limit_degrees
        }
        limit(bone, "LIMIT_ROTATION", ranges)
    points, faces = elbow_surface()
    mesh = bpy.data.meshes.new("limb")
    mesh.from_pydata(points.tolist(), [], faces.tolist())
    mesh.update()
    mesh_object = link(bpy.data.objects.new("limb", mesh))
    mesh_object.parent = armature_object
    mesh_object.modifiers.new("Armature", "ARMATURE").object = armature_object
    return mesh_object, armature_object


def add_smooth_weights(
    mesh_object: bpy.types.Object, armature_object: bpy.types.Object, max_influences: int, width: float
) -> None:
    """Add weights that fall off with the distance from the middle of each bone.

    Args:
        mesh_object, armature_object: objects of a `limb`.
        max_influences: largest number of bones per vertex.
        width: width of the falloff, meters.
    """
    x_positions = np.array([vertex.co.x for vertex in mesh_object.data.vertices])
    bones = [bone for bone in armature_object.data.bones if bone.use_deform]
    bone_centers = np.array([(bone.head_local.x + bone.tail_local.x) / 2 for bone in bones])
    weights = np.exp(-(((x_positions[:, None] - bone_centers) / width) ** 2))
    weights[weights < np.sort(weights, axis=1)[:, -max_influences][:, None]] = 0.0
    weights /= weights.sum(axis=1, keepdims=True)
    for bone, bone_weights in zip(bones, weights.T, strict=True):
        group = mesh_object.vertex_groups.new(name=bone.name)
        for vertex in np.flatnonzero(bone_weights):
            group.add([int(vertex)], float(bone_weights[vertex]), "REPLACE")


def add_delta_mush(mesh_object: bpy.types.Object, iterations: int = 6) -> None:
    """Add delta mush as the last modifier, so that the rig differs from linear skinning."""
    modifier = mesh_object.modifiers.new("Mush", "CORRECTIVE_SMOOTH")
    modifier.rest_source, modifier.factor, modifier.iterations = "ORCO", 0.6, iterations


def wave(armature_object: bpy.types.Object, bone_name: str) -> bpy.types.Action:
    """Key a rotation of a bone in a new action, which the armature object then no longer has."""
    bone = armature_object.pose.bones[bone_name]
    bone.rotation_mode = "XYZ"
    animation = armature_object.animation_data_create()
    animation.action = bpy.data.actions.new(f"wave {bone_name}")
    animation.action.use_fake_user = True
    for frame, angle in ((1, -0.4), (20, 0.6)):
        bone.rotation_euler = (angle, 0.3 * angle, 0.0)
        bone.keyframe_insert("rotation_euler", frame=frame)
    action, animation.action = animation.action, None
    bone.rotation_euler = (0, 0, 0)
    return action
